"""What committing costs of a run: the same sweep with its blocks kept, and thrown away, in turns.

`python -m benchmarks.commit_overhead [SCENARIOS] [ROUNDS] [FOLDER]`: a million and three by
default, in a temporary folder. A round is a run of each, the other one first every time. Also in
processor time, which other work on the machine disturbs less.
"""

import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from unittest.mock import patch

from sweeps import runner
from sweeps.spec.reading import parse
from sweeps.spec.types import Sweep
from sweeps.store.commit import Values, Writer
from sweeps.store.ledger import Row

PLAN = """
name = "overhead"
[sample]
n = {n}
ranges = {{ K0 = {{ log = [1.0, 1000.0] }}, Kenv = {{ log = [10.0, 1000.0] }} }}
"""


def thrown_away(writer: Writer, values: Values, row: Row) -> Row:
    """Instead of `Writer.commit`."""
    return row


def seconds(plan: Sweep, keep: bool, folder: str | None) -> tuple[float, float]:
    """How long the blocks of a new store take, and how much processor time."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        store = runner.start(Path(place) / "a.zarr", plan, None, 32)
        with patch.object(Writer, "commit", Writer.commit if keep else thrown_away):
            began, worked = time.perf_counter(), time.process_time()
            runner.run(store, lambda progress: None)
            return time.perf_counter() - began, time.process_time() - worked


def main(n: int = 1_000_000, rounds: int = 3, folder: str | None = None) -> None:
    """Measure and tell."""
    runner.configure(32)
    seconds(parse(PLAN.format(n=1000), "overhead"), True, folder)  # compiles
    plan, ratios = parse(PLAN.format(n=n), "overhead"), []
    for i in range(rounds):
        times = {keep: seconds(plan, keep, folder) for keep in (i % 2 == 0, i % 2 == 1)}
        ratios.append(
            [kept / lost - 1 for kept, lost in zip(times[True], times[False], strict=True)]
        )
        sys.stdout.write(
            "committed {:.2f} s, {:.2f} s of processors; ".format(*times[True])
            + "thrown away {:.2f} s, {:.2f} s of processors\n".format(*times[False])
        )
    wall, cpu = (100 * median(column) for column in zip(*ratios, strict=True))
    sys.stdout.write(f"{n:,} scenarios: committing costs {wall:+.1f} %, processors {cpu:+.1f} %\n")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*map(int, given[:2]), *given[2:])  # type: ignore[arg-type]
