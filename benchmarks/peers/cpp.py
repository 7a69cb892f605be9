"""The C++ twin: `twin.cpp`, built once per machine and called through ctypes."""

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from benchmarks.child import Missing
from benchmarks.peers import packed
from fic_jax import Metrics, Params

SOURCE = Path(__file__).with_name("twin.cpp")
# No flag here lets the compiler reorder a sum or assume that NaN and infinity can't occur: both
# would break the compensated sums and the metrics of a run that diverges.
FLAGS = (
    "-O3",
    "-march=native",
    "-std=c++17",
    "-shared",
    "-fPIC",
    "-pthread",
    "-ffp-contract=fast",  # FMA contraction, as in XLA
    "-fno-math-errno",
    "-fno-trapping-math",  # nobody reads the exception flags; comparisons may become blends
    # The order of instructions, together worth 7 %: the law is one long chain of dependent
    # operations, so independent work has to stand between them.
    "-fno-tree-ter",
    "-fschedule-insns",
    "-fsched-pressure",
)
REALS = (
    "nmse",
    "nmse_tail",
    "convergence_time",
    "steady_error",
    "peak_torque",
    "overshoot",
    "contact_time",
    "contact_lost",
    "energy_in",
)


def prepare(batch: Params, dt: float, n_steps: int, threads: int = 2) -> Callable[[], Metrics]:
    """Build the twin and pack the batch. Raises Missing without a compiler that can build it."""
    columns = packed(batch)
    real = ctypes.c_float if columns.dtype == np.float32 else ctypes.c_double
    library = ctypes.CDLL(str(_built()))
    run = library.run_float if columns.dtype == np.float32 else library.run_double
    run.restype = None

    def once() -> Metrics:
        n = columns.shape[1]
        reals = np.empty((len(REALS), n), columns.dtype)
        switches, finite = np.empty(n, np.int32), np.empty(n, np.uint8)
        out = [ctypes.c_void_p(a.ctypes.data) for a in (reals, switches, finite)]
        scenarios = ctypes.c_void_p(columns.ctypes.data)
        run(scenarios, ctypes.c_int64(n), real(dt), n_steps, threads, *out)
        named = dict(zip(REALS, reals, strict=True))
        return Metrics(**named, mode_switches=switches, finite=finite.astype(bool))

    return once


@lru_cache
def _built() -> Path:
    """The shared library; it is built again if source, flags or compiler have changed."""
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        raise Missing("g++ was not found")
    version = _output([compiler, "--version"]) + _output([compiler, "-Q", "--help=target", *FLAGS])
    key = hashlib.sha256("\n".join([SOURCE.read_text(), *FLAGS, version]).encode()).hexdigest()
    target = Path(tempfile.gettempdir()) / f"fic-jax-peers-{os.getuid()}" / f"{key[:16]}.so"
    if not target.exists():
        target.parent.mkdir(mode=0o700, exist_ok=True)
        _build(compiler, target)
    return target


def _build(compiler: str, target: Path) -> None:
    """Compile next to the target and rename, so that nobody loads half a library."""
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        fresh = Path(folder) / target.name
        subprocess.run([compiler, *FLAGS, str(SOURCE), "-o", str(fresh)], check=True)
        fresh.replace(target)


def _output(command: list[str]) -> str:
    """What the compiler prints. Raises Missing if it refuses, as a compiler other than GCC does."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise Missing(f"{Path(command[0]).name} is not GCC, which the twin needs: {last}")
    return done.stdout
