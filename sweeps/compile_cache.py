"""Where compiled programs are kept from one run to the next."""

import hashlib
import os
import platform
from pathlib import Path

VARIABLE = "FIC_SWEEP_CACHE"  # names another folder; empty: nothing is kept


def programs() -> Path | None:
    """The folder of this processor's programs, or None where nothing can or shall be kept.

    A home folder may be shared by machines whose processors differ, and a program made for one
    can stop with an illegal instruction on another.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen == "":
        return None
    try:
        folder = (Path(chosen) if chosen else _of_user()) / _processor()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home, or not ours to write in: no reason not to run
        return None
    return folder if os.access(folder, os.W_OK) else None


def _of_user() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fic-sweep"


def _processor() -> str:
    """A short name for what this processor can do."""
    identity = f"{platform.machine()} {platform.processor()} {extensions()}"
    return hashlib.sha256(identity.encode()).hexdigest()[:12]


def extensions() -> str:
    """What this processor can do beyond its base, in Linux's words; empty where nobody tells."""
    told = cpuinfo()
    return told.get("flags") or told.get("Features") or ""


def cpuinfo() -> dict[str, str]:
    """The first processor's lines of Linux's list; empty elsewhere."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return {}
    pairs = (line.partition(":") for line in text.split("\n\n")[0].splitlines())
    return {key.strip(): value.strip() for key, _, value in pairs}
