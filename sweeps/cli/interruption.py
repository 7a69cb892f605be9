"""Ctrl-C, SIGTERM and SIGHUP: stop between two blocks, so that every finished block is on disk."""

import os
import signal
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sweeps.runner import Progress


@dataclass
class Stop:
    """Whether the user has requested a stop."""

    requested: bool = False

    def raise_if_requested(self) -> None:
        """Raise KeyboardInterrupt if the user has requested a stop."""
        if self.requested:
            raise KeyboardInterrupt

    def after_block(self, progress: "Progress") -> None:
        """Raise KeyboardInterrupt if the user has requested a stop and cells are left to do."""
        if progress.done < progress.cells:
            self.raise_if_requested()


def stop_on_signals() -> Stop:
    """The first signal requests a stop, the second ends the process at once.

    A signal raises nothing: an exception inside XLA's compiler would crash the process.
    """
    stop = Stop()

    def request(_signum: int, _frame: object) -> None:
        if stop.requested:
            os._exit(1)  # finished blocks are on disk
        stop.requested = True
        with suppress(OSError):  # the terminal may be gone
            os.write(2, b"fic-sweep: stopping after this block; a second signal stops at once\n")

    for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signum != signal.SIGHUP or signal.getsignal(signum) != signal.SIG_IGN:  # nohup
            signal.signal(signum, request)
    return stop


def raise_on_signals() -> None:
    """Ctrl-C and SIGTERM raise KeyboardInterrupt at once, so that temporary files are removed."""
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, signal.default_int_handler)
