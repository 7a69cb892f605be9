"""Where a store is: the path that a user typed, resolved once, before anything is done there."""

import os
import unicodedata
from pathlib import Path

from sweeps.spec.mistakes import SweepError, printable


def place(typed: str | Path) -> Path:
    """The path with `~`, `.`, `..` and links resolved; relative if it was and lies below here.

    Raises SweepError for a path that is empty, has control characters, or is relative to a folder
    that was deleted.
    """
    text = os.fspath(typed)
    if not text or text.isspace():
        raise SweepError("a path must name a file or a folder, but is empty")
    if any(unicodedata.category(c) in ("Cc", "Zl", "Zp") for c in text):
        raise SweepError(f"{printable(text)}: a path must have no control characters")
    path = Path(os.path.expanduser(text))
    if path.is_absolute():
        return Path(os.path.realpath(path))
    try:
        real, here = Path(os.path.realpath(path)), Path(os.getcwd())
    except FileNotFoundError:
        raise SweepError(f"{path}: the folder that you are in was deleted") from None
    return real.relative_to(here) if here in real.parents else real


def place_of_store(typed: str | Path) -> Path:
    """The place of a store: it is built, and extended, beside its name. Raises SweepError."""
    path = place(typed)
    if not path.name:
        raise SweepError(f"{path}: is no result store, and can be none")
    return path


def before_extension(path: Path) -> Path:
    """Where a store waits, until the extended one has its name."""
    return path.with_name(f".{path.name}.before")


def store_around(path: Path) -> Path | None:
    """The store in which a path lies, if any."""
    parents = Path(os.path.realpath(path)).parents
    return next((folder for folder in parents if os.path.isfile(folder / "zarr.json")), None)


def place_of_new(typed: str | Path) -> Path:
    """The place of something new. Raises SweepError if the path has a link that leads nowhere."""
    path = Path(os.path.expanduser(typed))
    for part in (path, *path.parents):
        if part.is_symlink() and not part.exists():
            raise SweepError(
                f"{path}: {part} is a link to {os.readlink(part)}, where nothing is; "
                "remove it or name another place"
            )
    return place_of_store(typed)
