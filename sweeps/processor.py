"""What Linux says about this processor."""

from pathlib import Path


def extensions() -> str:
    """Extensions of the instruction set, in Linux's names; empty on another system."""
    info = cpuinfo()
    return info.get("flags") or info.get("Features") or ""


def cpuinfo() -> dict[str, str]:
    """The first processor's entries in /proc/cpuinfo; empty on another system."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return {}
    pairs = (line.partition(":") for line in text.split("\n\n")[0].splitlines())
    return {key.strip(): value.strip() for key, _, value in pairs}
