"""The machine: processor, versions, load."""

import os
import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import fic_jax
from fic_jax.lanes import cores
from sweeps.processor import cpuinfo, extensions
from sweeps.provenance import revision

PACKAGES = ("jax", "jaxlib", "llvmlite", "numpy", "numba", "diffrax")
EXTENSIONS = {"avx2": "avx2", "avx512f": "avx512", "asimd": "neon", "neon": "neon"}  # flag: name


def machine() -> dict[str, Any]:
    """Processor, cores in use, vector extensions, load average now, versions."""
    info, flags = cpuinfo(), extensions().lower().split()
    vector = {name for flag, name in EXTENSIONS.items() if flag in flags}
    if not info and platform.machine() == "arm64":  # macOS has no /proc, and every arm64 has NEON
        vector = {"neon"}
    return {
        "cpu": info.get("model name") or platform.processor() or platform.machine(),
        "architecture": platform.machine(),
        "cores": cores(),
        "vector": sorted(vector),
        "load": [round(load, 2) for load in os.getloadavg()],
        "versions": {
            "python": platform.python_version(),
            "fic_jax": fic_jax.__version__,
            "revision": revision(),
            **{name: _version(name) for name in PACKAGES},
            "c++": _compiler(),
        },
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _compiler() -> str | None:
    """The first line of `g++ --version`."""
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        return None
    done = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False)
    return (done.stdout.splitlines() or [compiler])[0]
