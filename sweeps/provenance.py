"""Which program, on what, made a store: what two runs must share to have the same bits."""

import hashlib
import os
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax

import fic_jax
import sweeps

# What must agree before a store is continued. The rest (device, revision) is told, not compared.
IDENTITY = (
    "program",
    "jax",
    "jaxlib",
    "llvmlite",
    "numpy",
    "scipy",
    "platform",
    "dtype",
    "xla_flags",
)

# What a larger store takes over from the one it began as.
KEPT = (*IDENTITY, "fic_jax", "revision", "device", "start")


def provenance(precision: int) -> dict[str, str]:
    """Attributes that name the program, its libraries, the device and the precision."""
    device = jax.devices()[0]
    return {
        "fic_jax": fic_jax.__version__,
        "program": fingerprint(),
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


def llvmlite() -> str:
    """The version of what compiles sweeps on a CPU; empty where XLA does."""
    try:
        return version("llvmlite")
    except PackageNotFoundError:
        return ""


def fingerprint() -> str:
    """SHA-256 of the sources that decide a number, from a cell's values to what is stored."""
    engine = sorted(Path(fic_jax.__file__).parent.rglob("*.py"))
    root = Path(sweeps.__file__).parent
    rooms = [sorted((root / room).rglob("*.py")) for room in ("spec", "plan", "store")]
    plan = [*(path for room in rooms for path in room), root / "runner.py"]
    digest = hashlib.sha256()
    for path in [*engine, *plan]:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def revision() -> str:
    """The source's git commit, with `+` where the working tree differs; the version elsewhere."""
    git = ["git", "-C", str(Path(fic_jax.__file__).parent)]
    try:
        described = subprocess.run(
            [*git, "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return fic_jax.__version__
    return described.stdout.strip()
