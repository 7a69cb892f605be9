"""The card, the machine and the versions; the memory that is used on the card."""

import ctypes
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from threading import Event, Thread
from typing import Any

import fic_jax
from benchmarks.child import BenchError, Child, Missing
from benchmarks.gpu.session import LeftOut, Session
from benchmarks.tables import Row, Table
from fic_jax.lanes import cores
from fic_jax.lanes.sources import digest

# what `nvidia-smi` says: its name for it, ours
CARD = {
    "name": "card",
    "driver_version": "driver",
    "memory.total": "memory",
    "compute_cap": "compute capability",
    "clocks.max.sm": "highest clock",
    "power.limit": "power limit",
}
PACKAGES = (
    "jax",
    "jaxlib",
    "jax-cuda13-plugin",
    "jax-cuda12-plugin",
    "llvmlite",
    "cuda-core",
    "cuda-bindings",
    "numpy",
)
SAMPLING = 0.003  # s between two readings of the memory


def measure(session: Session) -> None:
    """Record the facts."""
    facts: dict[str, Any] = {}
    answer = output(smi(*CARD))
    values = answer.splitlines()[0].split(", ") if answer else []
    facts |= dict(zip(CARD.values(), values, strict=False))
    if header := re.search(r"CUDA Version: *([\d.]+)", output(["nvidia-smi"])):
        facts["CUDA of the driver"] = header[1]
    try:
        with Child() as child:
            facts["JAX's devices"] = session.ask(child, "benchmarks.gpu.card.devices")
            lanes = session.ask(child, "fic_jax.engine.arithmetic", backend="lanes")
            facts["arithmetic of the CPU"] = lanes
    except (BenchError, Missing, LeftOut) as why:
        facts["failed"] = str(why)
    if compiler := output(["nvcc", "--version"]):
        facts["nvcc"] = compiler.splitlines()[-1]
    model = re.search(r"Model name: *(.+)", output(["lscpu"]))
    facts["processor"] = model[1] if model else platform.processor() or platform.machine()
    facts["cores in use"] = cores()
    facts["load average at the start"] = " ".join(f"{load:.2f}" for load in os.getloadavg())
    facts["python"] = sys.version.split()[0]
    facts["fic_jax"] = f"{fic_jax.__version__}, numerics {fic_jax.NUMERICS}"
    folder = Path(fic_jax.__file__).parent
    git = ["git", "-C", str(folder), "describe", "--always", "--abbrev=12", "--dirty=+"]
    facts["revision"] = output([*git, "--exclude=*"]).strip() or "no git repository"
    facts["sources of fic_jax"] = (digest(folder) or "changed since the start")[:12]
    for package in PACKAGES:
        try:
            facts[package] = version(package)
        except PackageNotFoundError:
            continue
    session.results.add("machine", "machine", facts=facts)


def tables(records: list[Row]) -> list[Table]:
    """One table, a row for each fact."""
    rows = [{"name": k, "value": v} for r in records for k, v in r.get("facts", {}).items()]
    return [Table("The machine", [("", "{name}"), ("", "{value}")], rows)] if rows else []


def devices() -> str:
    """The devices that JAX uses (called in a child)."""
    import jax

    kinds = [device.device_kind for device in jax.local_devices()]
    return f"{len(kinds)} x {kinds[0]} ({jax.local_devices()[0].platform})"


def no_card() -> str:
    """Why no NVIDIA card can be used, in one line; empty if one can."""
    if output(["nvidia-smi", "-L"]).startswith("GPU"):
        return ""
    try:
        with Child() as child:
            found = child.call("benchmarks.gpu.card.devices")
    except BenchError as error:
        found = f"none: {error}"
    return (
        "" if found.endswith("(gpu)") else f"nvidia-smi lists none, and JAX's devices are {found}"
    )


def smi(*fields: str) -> list[str]:
    """The command that prints these values of the first card."""
    return ["nvidia-smi", "-i", "0", f"--query-gpu={','.join(fields)}", "--format=csv,noheader"]


def output(command: list[str]) -> str:
    """What a command prints; empty if it does not exist or fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout


class _Memory(ctypes.Structure):
    """NVML's nvmlMemory_t."""

    _fields_ = [(name, ctypes.c_ulonglong) for name in ("total", "free", "used")]


@contextmanager
def memory_used() -> Iterator[list[int]]:
    """Bytes used on the first card, read every few milliseconds while the `with` runs.

    Raises Missing without NVML, the library of nvidia-smi.
    """
    try:
        nvml = ctypes.CDLL("libnvidia-ml.so.1")
    except OSError as error:
        raise Missing("libnvidia-ml.so.1 was not found") from error
    card, memory = ctypes.c_void_p(), _Memory()
    if nvml.nvmlInit_v2() or nvml.nvmlDeviceGetHandleByIndex_v2(0, ctypes.byref(card)):
        raise Missing("libnvidia-ml.so.1 opens no card")
    used: list[int] = []
    done = Event()

    def read() -> None:
        while not done.wait(SAMPLING):
            nvml.nvmlDeviceGetMemoryInfo(card, ctypes.byref(memory))
            used.append(memory.used)

    reader = Thread(target=read, daemon=True)
    reader.start()
    try:
        yield used
    finally:
        done.set()
        reader.join()
