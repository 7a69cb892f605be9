"""What committing blocks adds to a run: the same sweep with its blocks stored, and dropped.

Every second round has the reverse order. Other work disturbs processor time less than wall time.
The stores are in a temporary folder; TMPDIR chooses another disk.
"""

import shutil
import tempfile
import time
from functools import partial
from pathlib import Path
from unittest.mock import patch

from benchmarks.child import Child
from benchmarks.plan import DT, Plan, Say
from benchmarks.tables import Table, measured
from sweeps import runner
from sweeps.spec.reading import parse
from sweeps.store.commit import Values, Writer
from sweeps.store.ledger import Row

SCENARIOS = 1_000_000
FILE = """
name = "commit"
[time]
dt = {dt}
t_end = {t_end}
[sample]
n = {n}
ranges = {{ K0 = {{ log = [1.0, 1000.0] }}, Kenv = {{ log = [10.0, 1000.0] }} }}
"""


def commit(plan: Plan, say: Say) -> Table:
    """Wall and processor time of both, and what committing adds in percent."""
    n = plan.scenarios or SCENARIOS
    rounds = plan.rounds(n)
    taken: dict[bool, list[dict[str, float]]] = {True: [], False: []}
    with tempfile.TemporaryDirectory(prefix="fic-sweep-bench-") as folder, Child() as child:
        run = partial(child.call, "benchmarks.commit.seconds", folder=folder, steps=plan.steps)
        child.call("sweeps.runner.configure", precision=32)
        run(n=1000, stored=True)  # compiles
        for i in range(rounds):
            say(f"commit: round {i + 1} of {rounds}")
            for stored in (i % 2 == 0, i % 2 == 1):
                taken[stored].append(run(n=n, stored=stored))
    rows = []
    for kind in ("wall", "processor"):
        with_, without = ([one[kind] for one in taken[stored]] for stored in (True, False))
        added = [100 * (a / b - 1) for a, b in zip(with_, without, strict=True)]
        rows.append(
            {
                "name": f"{kind} time, s",
                "stored": measured(with_),
                "dropped": measured(without),
                "added_percent": measured(added),
            }
        )
    return Table(
        f"Committing the blocks of a run of {n:,} scenarios of {plan.steps:,} steps",
        [
            ("", "{name}"),
            ("stored, median", "{stored[median]:.2f}"),
            ("dropped, median", "{dropped[median]:.2f}"),
            ("added, %", "{added_percent[median]:+.1f}"),
        ],
        rows,
    )


def seconds(folder: str, steps: int, n: int, stored: bool) -> dict[str, float]:
    """Called in a child: wall and processor time of a run into a new store."""
    plan = parse(FILE.format(n=n, dt=DT, t_end=round(steps * DT, 9)), "commit")
    store = runner.start(Path(folder) / "bench.zarr", plan, None, 32)
    with patch.object(Writer, "commit", Writer.commit if stored else _drop):
        began, worked = time.perf_counter(), time.process_time()
        runner.run(store, lambda progress: None)
        wall, processor = time.perf_counter() - began, time.process_time() - worked
    shutil.rmtree(store.path)
    return {"wall": wall, "processor": processor}


def _drop(writer: Writer, values: Values, row: Row) -> Row:
    """In place of `Writer.commit`."""
    return row
