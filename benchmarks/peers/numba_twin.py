"""The numba peer: `prange` over scenarios; numba_kernel.py simulates each."""

from collections.abc import Callable

import numpy as np

from benchmarks.peers import installed, packed
from benchmarks.peers.cpp import REALS
from fic_jax import Metrics, Params


def prepare(batch: Params, dt: float, n_steps: int, threads: int = 2) -> Callable[[], Metrics]:
    """Compile the kernel and store the batch as [N, field]. Raises Missing without numba."""
    numba = installed("numba")
    from benchmarks.peers.numba_kernel import Numbers, run

    columns = np.ascontiguousarray(packed(batch).T)
    real = columns.dtype.type
    ulps = 4 * np.finfo(real).eps
    constants = Numbers(*(real(a) for a in (dt, 0, 0.5, 1, 2, 4, 6, 0.05, ulps, np.inf)))
    n = len(columns)
    reals, counts = np.empty((n, len(REALS)), columns.dtype), np.empty((n, 2), np.int32)
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    run(columns[:1], constants, 1, reals[:1], counts[:1])

    def once() -> Metrics:
        run(columns, constants, n_steps, reals, counts)
        named = dict(zip(REALS, reals.T.copy(), strict=True))
        switches, finite = counts.T.copy()
        return Metrics(**named, mode_switches=switches, finite=finite.astype(bool))

    return once
