"""What committing blocks adds to a run: the same sweep with its blocks stored, and dropped.

A round runs both, the other one first every time. Processor time is disturbed less by other work.
The stores are in a temporary folder; TMPDIR chooses another disk.
"""

import tempfile
import time
from pathlib import Path
from unittest.mock import patch

from benchmarks.child import Child
from benchmarks.plan import Plan, Say
from benchmarks.tables import Table, measured
from sweeps import runner
from sweeps.spec.reading import parse
from sweeps.store.commit import Values, Writer
from sweeps.store.ledger import Row

SCENARIOS = 1_000_000
FILE = """
name = "commit"
[sample]
n = {n}
ranges = {{ K0 = {{ log = [1.0, 1000.0] }}, Kenv = {{ log = [10.0, 1000.0] }} }}
"""


def commit(plan: Plan, say: Say) -> Table:
    """Wall and processor time of both, and what committing adds in percent."""
    n = plan.scenarios or SCENARIOS
    rounds = plan.rounds(n)
    taken: dict[bool, list[dict[str, float]]] = {True: [], False: []}
    with Child() as child:
        child.call("sweeps.runner.configure", precision=32)
        child.call("benchmarks.commit.seconds", n=1000, stored=True)  # compiles
        for i in range(rounds):
            say(f"commit: round {i + 1} of {rounds}")
            for stored in (i % 2 == 0, i % 2 == 1):
                taken[stored].append(child.call("benchmarks.commit.seconds", n=n, stored=stored))
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
        f"Committing the blocks of a run of {n:,} scenarios",
        [
            ("", "{name}"),
            ("stored, median", "{stored[median]:.2f}"),
            ("dropped, median", "{dropped[median]:.2f}"),
            ("added, %", "{added_percent[median]:+.1f}"),
        ],
        rows,
    )


def seconds(n: int, stored: bool) -> dict[str, float]:
    """Called in a child: wall and processor time of a run into a new store."""
    plan = parse(FILE.format(n=n), "commit")
    commit = Writer.commit if stored else _drop
    with tempfile.TemporaryDirectory() as folder, patch.object(Writer, "commit", commit):
        store = runner.start(Path(folder) / "a.zarr", plan, None, 32)
        began, worked = time.perf_counter(), time.process_time()
        runner.run(store, lambda progress: None)
        wall, processor = time.perf_counter() - began, time.process_time() - worked
    return {"wall": wall, "processor": processor}


def _drop(writer: Writer, values: Values, row: Row) -> Row:
    """In place of `Writer.commit`."""
    return row
