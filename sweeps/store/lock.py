"""One process at a time changes a store."""

import fcntl
import json
import os
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from sweeps.spec.mistakes import SweepError, printable
from sweeps.store.fsync import UNSUPPORTED

LOCK = "owner.lock"


@dataclass(frozen=True)
class Lock:
    """The lock of a store, held by this process."""

    descriptor: int
    killed_in: int | None  # the block that the last process computed when it was killed

    def computing(self, block: int) -> None:
        """Note the block that this process computes, for the next one after a kill.

        Without fsync: the note is a hint.
        """
        with suppress(OSError):
            _write(self.descriptor, block)


def warn_without_locks(error: OSError) -> None:
    """Warn that nothing keeps two processes apart."""
    warnings.warn(
        f"the file system has no locks ({error.strerror}): nobody keeps a second process out; "
        "let no other change or read the store meanwhile",
        RuntimeWarning,
        stacklevel=1,  # one place: Python shows it once
    )


def _take(descriptor: int, kind: int, folder: Path) -> None:
    """Take a lock, LOCK_EX or LOCK_SH, or warn where the file system has none.

    Raises SweepError with the process that holds it, OSError.
    """
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _in_use(folder, descriptor) from None
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise
        warn_without_locks(error)


@contextmanager
def locked(folder: Path) -> Iterator[Lock]:
    """Lock a folder. The system releases the lock when the process ends, also by a kill.

    Where the file system has no locks, warns that nobody keeps a second process out. Raises
    SweepError with the process that holds it, OSError if the folder can't be written.
    """
    # O_NOFOLLOW: a link could make us overwrite a file outside the store
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(folder / LOCK, flags, 0o666)
    try:
        _take(descriptor, fcntl.LOCK_EX, folder)
        block = _read(descriptor).get("block")
        _write(descriptor, None)
        try:
            yield Lock(descriptor, block if isinstance(block, int) else None)
        finally:  # also after an error: the process was not killed
            with suppress(OSError):
                os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


@contextmanager
def unchanged(folder: Path) -> Iterator[None]:
    """Keep other processes from changing a store that this one only reads.

    Raises SweepError if one does already, OSError if the lock can't be read. Where the file system
    has no locks, nobody knows.
    """
    descriptor = os.open(folder / LOCK, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        _take(descriptor, fcntl.LOCK_SH, folder)
        yield
    finally:
        os.close(descriptor)


def _in_use(folder: Path, descriptor: int) -> SweepError:
    """The refusal of a folder that another process has locked."""
    note = _read(descriptor)
    # a process that only reads leaves no note
    what = "changed" if note else "merged"
    who = printable(
        f"process {note.get('pid', '?')} on {note.get('host', '?')}" if note else "another process"
    )
    return SweepError(f"{folder}: is being {what} by {who}; wait for it to end")


def _write(descriptor: int, block: int | None) -> None:
    note = {"pid": os.getpid(), "host": socket.gethostname(), "block": block}
    content = json.dumps(note).encode()
    os.pwrite(descriptor, content, 0)
    os.ftruncate(descriptor, len(content))


def _read(descriptor: int) -> dict[str, object]:
    try:
        note = json.loads(os.pread(descriptor, 1000, 0))
    except (ValueError, RecursionError):  # empty after an orderly end
        return {}
    return note if isinstance(note, dict) else {}
