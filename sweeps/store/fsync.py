"""Files that are whole or not there, and that a power cut leaves in place."""

import os
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path

PARTIAL = ".partial"  # ending of a file or folder under way; what is left of one may be removed


def write(files: Mapping[Path, bytes]) -> None:
    """Put files on disk, each whole or as it was; once this returns, a power cut loses none.

    Contents first, under names of their own; then, when all are on the disk, their places; then
    the folders that hold the places. Raises OSError, having removed what it can.
    """
    partials = {place: place.with_name(place.name + PARTIAL) for place in files}
    try:
        with ExitStack() as opened:
            descriptors = []
            for place, content in files.items():
                descriptor = os.open(partials[place], _NEW, 0o666)
                opened.callback(os.close, descriptor)
                _write_all(descriptor, content)
                descriptors.append(descriptor)
            for descriptor in descriptors:  # after all are written: the disk takes them together
                os.fsync(descriptor)
        for place, partial in partials.items():
            os.replace(partial, place)
        for folder in dict.fromkeys(place.parent for place in files):
            sync(folder)
    except OSError:
        for partial in partials.values():
            with suppress(OSError):
                os.unlink(partial)
        raise


def sync(path: Path) -> None:
    """Bring a file, or the names in a folder, onto the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Bring a folder and all that is in it onto the disk."""
    for path in folder.rglob("*"):
        sync(path)
    sync(folder)


# No link is followed out of a store: a store can come from somebody else.
_NEW = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC


def _write_all(descriptor: int, content: bytes) -> None:
    left = memoryview(content)
    while left:  # the kernel may take a part only
        left = left[os.write(descriptor, left) :]
