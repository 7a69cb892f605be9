"""What made a store's numbers: two runs that agree in `IDENTITY` give the same bits."""

import os
import subprocess
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

import fic_jax
from fic_jax.engine import arithmetic
from sweeps.spec.types import RANGES

# `resume` continues a store only if all of these are equal; the rest is for the reader.
IDENTITY = (
    "numerics",
    "ranges",
    "arithmetic",
    "jax",
    "jaxlib",
    "llvmlite",
    "numpy",
    "scipy",
    "platform",
    "dtype",
    "xla_flags",
)


def provenance(precision: int) -> dict[str, Any]:
    """Attributes of a store: numerics version, arithmetic, libraries, device and precision."""
    device = jax.devices()[0]
    return {
        "fic_jax": fic_jax.__version__,
        "numerics": fic_jax.NUMERICS,
        "ranges": RANGES,
        "arithmetic": arithmetic(),
        "revision": revision(),
        "jax": jax.__version__,
        "jaxlib": version("jaxlib"),
        "llvmlite": llvmlite(),
        "numpy": version("numpy"),
        "scipy": version("scipy"),
        "platform": device.platform,
        "device": f"{jax.local_device_count()} x {device.device_kind}",
        "dtype": f"float{precision}",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def differences(began: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """What of `IDENTITY` differs between a store's attributes and those of this process."""
    return [
        f"{key} was {began.get(key) or 'none'}, is {now[key] or 'none'}"
        for key in IDENTITY
        if began.get(key) != now[key]
    ]


def unlike(keys: Iterable[str], these: Mapping[str, Any], those: Mapping[str, Any]) -> list[str]:
    """What differs between two programs, as "jax is 0.10.2, not 0.11.0"."""
    return [
        f"{key} is {these.get(key) or 'none'}, not {those.get(key) or 'none'}"
        for key in keys
        if these.get(key) != those.get(key)
    ]


def llvmlite() -> str:
    """The version of what compiles sweeps for a CPU; empty if XLA does."""
    try:
        return version("llvmlite")
    except PackageNotFoundError:
        return ""


def revision() -> str:
    """The git commit of the source, with `+` if the working tree differs; else the version."""
    git = ["git", "-C", str(Path(fic_jax.__file__).parent)]
    try:
        described = subprocess.run(
            [*git, "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            capture_output=True,
            encoding="utf-8",  # whatever the locale
            errors="replace",
            check=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return fic_jax.__version__
    return described.stdout.strip()
