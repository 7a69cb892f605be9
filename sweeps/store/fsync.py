"""Put whole files on the disk, so that neither a kill nor a power cut leaves half of one."""

import errno
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

PARTIAL = ".partial"  # suffix of an unfinished file or folder; the next writer may delete it

# O_NOFOLLOW: a store from somebody else may contain a link to a file outside it.
_NEW = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC

# What a file system answers that lacks a call: locks on Lustre and NFS, fsync of a folder on SMB.
UNSUPPORTED = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL}
NO_FSYNC = UNSUPPORTED | {errno.EACCES, errno.EPERM, errno.EBADF, errno.EISDIR}


def write(files: Mapping[Path, bytes]) -> None:
    """Write files, each whole or not at all. After the return a power cut loses none.

    Raises OSError, after it has deleted the partial files.
    """
    stage(files)
    publish(files)


def stage(files: Mapping[Path, bytes], suffix: str = PARTIAL) -> None:
    """Write and fsync files under partial names, NAME + `suffix`, for `publish`.

    Raises OSError, after it has deleted the partial files.
    """
    partials = {path: path.with_name(path.name + suffix) for path in files}
    with deleted_after_error(partials.values()), ExitStack() as opened:
        descriptors = []
        for path, content in files.items():
            descriptor = os.open(partials[path], _NEW, 0o666)
            opened.callback(os.close, descriptor)
            _write_all(descriptor, content)
            descriptors.append(descriptor)
        for descriptor in descriptors:  # after all writes: the disk takes them together
            _fsync(descriptor)


def publish(files: Iterable[Path], suffix: str = PARTIAL) -> None:
    """Give staged files their names, and put the names on the disk.

    Raises OSError, after it has deleted the partial files.
    """
    partials = {path: path.with_name(path.name + suffix) for path in files}
    with deleted_after_error(partials.values()):
        for path, partial in partials.items():
            os.replace(partial, path)
        for folder in dict.fromkeys(path.parent for path in partials):
            sync(folder)


@contextmanager
def deleted_after_error(partials: Iterable[Path]) -> Iterator[None]:
    """Delete partial files if an OSError is raised inside."""
    try:
        yield
    except OSError:
        for partial in partials:
            with suppress(OSError):
                os.unlink(partial)
        raise


def sync(path: Path) -> None:
    """Fsync a file, or a folder and so the names in it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except PermissionError as error:  # a folder that one may write in, but not list
        _warn_without_fsync(error)
        return
    try:
        _fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Fsync a folder and everything in it."""
    for path in folder.rglob("*"):
        sync(path)
    sync(folder)


def _fsync(descriptor: int) -> None:
    """Fsync, or warn where the file system has none."""
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in NO_FSYNC:
            raise
        _warn_without_fsync(error)


def _warn_without_fsync(error: OSError) -> None:
    warnings.warn(
        f"the file system refuses fsync ({error.strerror}): a power cut may damage finished blocks",
        RuntimeWarning,
        stacklevel=1,  # one place: Python shows it once
    )


def _write_all(descriptor: int, content: bytes) -> None:
    left = memoryview(content)
    while left:  # one call may write a part only
        left = left[os.write(descriptor, left) :]
