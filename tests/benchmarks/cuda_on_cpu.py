"""The CUDA twin as a peer where there is no card: g++ compiles the same source for the CPU."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.child import Missing
from benchmarks.peers.cpp import REALS
from benchmarks.peers.cuda import SOURCE, laid_out
from fic_jax import Metrics, Params

SHIM = Path(__file__).with_suffix(".cpp")


def prepare(batch: Params, dt: float, n_steps: int) -> Callable[[], Metrics]:
    """Build the twin and lay out the batch. Raises Missing without g++."""
    if shutil.which("g++") is None:
        raise Missing("g++ was not found")
    columns, where = laid_out(batch)
    n = np.size(batch.K0)
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / "twin.so"
        include = f"-I{SOURCE.parent}"
        flags = ["-std=c++17", "-O2", "-shared", "-fPIC", "-ffp-contract=fast"]
        subprocess.run(["g++", *flags, include, str(SHIM), "-o", str(built)], check=True)
        library = ctypes.CDLL(str(built))
    single = columns.dtype == np.float32
    run = library.twin_float_on_cpu if single else library.twin_double_on_cpu
    step = (ctypes.c_float if single else ctypes.c_double)(dt)

    def once() -> Metrics:
        reals = np.empty((len(REALS), n), columns.dtype)
        switches, finite = np.empty(n, np.int32), np.empty(n, np.uint8)
        before, after = (
            [ctypes.c_void_p(a.ctypes.data) for a in arrays]
            for arrays in ((columns, where), (reals, switches, finite))
        )
        for first, last in ((0, n // 3), (n // 3, n)):  # a launch need not have all scenarios
            scenarios = [ctypes.c_longlong(i) for i in (n, first, last)]
            run(*before, *scenarios, step, n_steps, *after)
        named = dict(zip(REALS, reals, strict=True))
        return Metrics(**named, mode_switches=switches, finite=finite.astype(bool))

    return once
