"""The one process that may change a store."""

import fcntl
import json
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from sweeps.spec.mistakes import SweepError, printable

NAME = "owner.lock"


@dataclass(frozen=True)
class Owner:
    """What a process holds while it changes a store."""

    descriptor: int
    died_at: int | None  # block that the owner before had in hand when it was killed

    def takes(self, block: int) -> None:
        """Note the block in hand, for whoever comes after a kill. Not flushed: it is a hint."""
        with suppress(OSError):
            _note(self.descriptor, block)


@contextmanager
def owning(folder: Path) -> Iterator[Owner]:
    """Own a store, or refuse: the lock goes with the process, however that ends.

    Raises SweepError naming the process that has it, OSError where nothing can be written.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(folder / NAME, flags, 0o666)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise SweepError(f"{folder}: its {NAME} is no file")
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            told = _read(descriptor)
            who = f"process {told.get('pid', '?')} on {told.get('host', '?')}"
            raise SweepError(
                f"{folder}: is being changed by {printable(who)}; wait for it to end"
            ) from None
        died_at = _read(descriptor).get("block")
        _note(descriptor, None)
        try:
            yield Owner(descriptor, died_at if isinstance(died_at, int) else None)
        finally:  # an orderly end, be it an error: nothing was killed
            with suppress(OSError):
                os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


def _note(descriptor: int, block: int | None) -> None:
    told = {"pid": os.getpid(), "host": socket.gethostname(), "block": block}
    content = json.dumps(told).encode()
    os.pwrite(descriptor, content, 0)
    os.ftruncate(descriptor, len(content))


def _read(descriptor: int) -> dict[str, object]:
    try:
        told = json.loads(os.pread(descriptor, 1000, 0))
    except (ValueError, RecursionError):  # empty: the owner before ended well; or none of ours
        return {}
    return told if isinstance(told, dict) else {}
