"""How far a run is, while it runs: a bar on a terminal, a line every ten seconds in a log."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from sweeps.cli.interruption import Stop

if TYPE_CHECKING:
    from sweeps.runner import Progress, RunBlocks
    from sweeps.store.opening import Store

LOG_INTERVAL = 10.0  # s


def run_with_progress(
    store: "Store", stop: Stop, run_blocks: "RunBlocks | None" = None
) -> "Progress":
    """Run the blocks of a store that are not done, in this process or by `run_blocks`.

    Raises KeyboardInterrupt on a requested stop.
    """
    # a notebook's `!` is a terminal that does not erase the bar's line
    bar = sys.stdout.isatty() and "JPY_PARENT_PID" not in os.environ
    return (_with_bar if bar else _with_lines)(store, stop, run_blocks)


@contextmanager
def blocks_counted(name: str) -> Iterator[Callable[[int, int], None]]:
    """A function that shows how many blocks are done, and how many there are."""
    if sys.stdout.isatty():
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
        from rich.progress import Progress as Bar

        columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TextColumn("blocks"))
        with Bar(*columns, transient=True) as bar:
            task = bar.add_task("", total=None)
            yield lambda done, blocks: bar.update(task, completed=done, total=blocks)
        return
    last = time.monotonic()

    def show(done: int, blocks: int) -> None:
        nonlocal last
        if time.monotonic() - last >= LOG_INTERVAL:
            last = time.monotonic()
            print(f"{done:,} of {blocks:,} blocks", flush=True)

    yield show


def _with_bar(store: "Store", stop: Stop, run_blocks: "RunBlocks | None") -> "Progress":
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    from sweeps import runner
    from sweeps.cli.messages import progress_line

    text = TextColumn("{task.percentage:>3.0f} % {task.fields[line]}")
    with Bar(TextColumn(store.grid.sweep.name), BarColumn(), text, transient=True) as bar:
        task = bar.add_task("", total=store.grid.most_runs, line="compiling")

        def show(progress: "Progress") -> None:
            bar.update(task, completed=progress.done, line=progress_line(progress))
            stop.after_block(progress)

        return runner.run(store, show, run_blocks=run_blocks)


def _with_lines(store: "Store", stop: Stop, run_blocks: "RunBlocks | None") -> "Progress":
    from sweeps import runner
    from sweeps.cli.messages import log_line

    last = time.monotonic()

    def show(progress: "Progress") -> None:
        nonlocal last
        if progress.ran and time.monotonic() - last >= LOG_INTERVAL:
            last = time.monotonic()
            print(log_line(progress), flush=True)
        stop.after_block(progress)

    return runner.run(store, show, run_blocks=run_blocks)
