"""Put whole files on the disk, so that neither a kill nor a power cut leaves half of one."""

import os
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path

PARTIAL = ".partial"  # suffix of an unfinished file or folder; the next writer may delete it

# O_NOFOLLOW: a store from somebody else may contain a link to a file outside it.
_NEW = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC


def write(files: Mapping[Path, bytes]) -> None:
    """Write files, each whole or not at all. After the return a power cut loses none.

    Raises OSError, after it has deleted the partial files.
    """
    partials = {path: path.with_name(path.name + PARTIAL) for path in files}
    try:
        with ExitStack() as opened:
            descriptors = []
            for path, content in files.items():
                descriptor = os.open(partials[path], _NEW, 0o666)
                opened.callback(os.close, descriptor)
                _write_all(descriptor, content)
                descriptors.append(descriptor)
            for descriptor in descriptors:  # after all writes: the disk takes them together
                os.fsync(descriptor)
        for path, partial in partials.items():
            os.replace(partial, path)
        for folder in dict.fromkeys(path.parent for path in files):
            sync(folder)
    except OSError:
        for partial in partials.values():
            with suppress(OSError):
                os.unlink(partial)
        raise


def sync(path: Path) -> None:
    """Fsync a file, or a folder and so the names in it."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Fsync a folder and everything in it."""
    for path in folder.rglob("*"):
        sync(path)
    sync(folder)


def _write_all(descriptor: int, content: bytes) -> None:
    left = memoryview(content)
    while left:  # one call may write a part only
        left = left[os.write(descriptor, left) :]
