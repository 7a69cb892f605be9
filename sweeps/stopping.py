"""Ctrl-C and a notebook's stop button while `sweeps.run` runs: it stops between two blocks."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from sweeps.runner import OnProgress, Progress


@contextmanager
def stopped_between_blocks(on_progress: OnProgress) -> Iterator[OnProgress]:
    """A callback for `on_progress` that raises after a block if SIGINT came; the context also does.

    It calls `on_progress` when something has changed. After the last block the context raises, so
    that a loop over sweeps stops too. An exception inside XLA's compiler may crash the process, and
    its traceback has 100 lines. Other threads get no signals, and a handler of the user's own
    stays.
    """
    ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    requested, last = False, None

    def request(_signum: int, _frame: object) -> None:
        nonlocal requested
        requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)  # the second one raises at once

    def report(progress: Progress) -> None:
        nonlocal last
        if progress != last:  # a cluster reports twice a second, so that a stop is seen
            last = progress
            on_progress(progress)
        if requested and progress.done < progress.cells:
            raise KeyboardInterrupt("stopped after a block; the same call continues")

    if ours:
        signal.signal(signal.SIGINT, request)
    try:
        yield report
        if requested:
            raise KeyboardInterrupt("stopped after the last block; the sweep is complete")
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
