"""Where numbers were taken: the machine, the versions, the load."""

import os
import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import fic_jax
from fic_jax.lanes import cores
from sweeps.cache import cpuinfo, extensions
from sweeps.provenance import revision

PACKAGES = ("jax", "jaxlib", "llvmlite", "numpy", "numba", "diffrax")
EXTENSIONS = {"avx2": "avx2", "avx512f": "avx512", "asimd": "neon", "neon": "neon"}  # as told: name


def machine() -> dict[str, Any]:
    """Processor, cores in use, vector extensions, load average now."""
    told = cpuinfo()
    flags = set(extensions().lower().split())
    vector = {name for flag, name in EXTENSIONS.items() if flag in flags}
    if not told and platform.machine() == "arm64":  # macOS has no /proc and always has it
        vector = {"neon"}
    return {
        "cpu": told.get("model name") or platform.processor() or platform.machine(),
        "architecture": platform.machine(),
        "cores": cores(),
        "vector": sorted(vector),
        "load": [round(load, 2) for load in os.getloadavg()],
    }


def versions() -> dict[str, str | None]:
    """What was measured; None for a peer that is not there."""
    ours = {"python": platform.python_version(), "fic_jax": fic_jax.__version__}
    return ours | {
        "revision": revision(),
        **{name: _version(name) for name in PACKAGES},
        "c++": _compiler(),
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _compiler() -> str | None:
    """The first line the C++ compiler says of itself."""
    found = shutil.which(os.environ.get("CXX", "g++"))
    if found is None:
        return None
    done = subprocess.run([found, "--version"], capture_output=True, text=True, check=False)
    return (done.stdout.splitlines() or [found])[0]
