"""The folder of the compile cache: compiled programs that later runs load."""

import hashlib
import os
import platform
import tempfile
import warnings
from pathlib import Path

from sweeps.processor import extensions

VARIABLE = "FIC_SWEEP_CACHE"  # environment: another folder, or no cache if empty


def folder() -> Path | None:
    """This processor's folder in the compile cache, or None where nothing can be written.

    The user may switch the cache off. Machines with different processors may share a home folder,
    and a program compiled for one of them can stop with an illegal instruction on another.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen == "":
        return None
    try:
        path = (_expanded(chosen) if chosen else _user_folder()) / _processor_name()
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home
        if chosen:
            why = getattr(error, "strerror", None) or error
            warnings.warn(
                f"{VARIABLE}={chosen}: can't be used ({why}): every run compiles again",
                RuntimeWarning,
                stacklevel=1,
            )
        return None
    return path


def _expanded(text: str) -> Path:
    """A path from the environment: a job's file sets it without a shell that expands `~`, `$HOME`.

    Raises OSError for a variable that is not set.
    """
    path = os.path.expandvars(os.path.expanduser(text))
    if path.startswith("~") or "$" in path:
        raise OSError(None, "it names a variable or a user that is not known")
    return Path(path)


def _user_folder() -> Path:
    """The folder for caches. XDG wants its path absolute, and a relative one ignored."""
    chosen = os.path.expanduser(os.environ.get("XDG_CACHE_HOME", ""))
    return (Path(chosen) if os.path.isabs(chosen) else Path.home() / ".cache") / "fic-sweep"


def _processor_name() -> str:
    identity = f"{platform.machine()} {platform.processor()} {extensions()}"
    return hashlib.sha256(identity.encode()).hexdigest()[:12]
