"""The folder of the compile cache: compiled programs that later runs load."""

import hashlib
import os
import platform
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
        path = (Path(chosen) if chosen else _user_folder()) / _processor_name()
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: the user has no home
        return None
    return path if os.access(path, os.W_OK) else None


def _user_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fic-sweep"


def _processor_name() -> str:
    identity = f"{platform.machine()} {platform.processor()} {extensions()}"
    return hashlib.sha256(identity.encode()).hexdigest()[:12]
