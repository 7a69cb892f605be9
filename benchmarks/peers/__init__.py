"""The default model as others would write it.

Each peer has `prepare(batch, dt, n_steps, threads)`, which returns a run: called without arguments,
it computes the metrics of the batch. `prepare` raises Missing where the peer can't run.

cpp.py, twin.cpp               C++ by g++: AVX where the processor has it, threads
cuda.py, twin.cu               CUDA by NVRTC: one scenario in each thread of a GPU
numba_twin.py, numba_kernel.py numba, `prange` over scenarios
diffrax_twin.py                a diffrax solver under a scan
plain.py                       jit(vmap(...)) of the public `evaluate`
"""

from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.child import Missing
from fic_jax import QUANTITIES, Params


def installed(module: str, package: str = "fic-jax[bench]") -> Any:
    """Import a module. Raises Missing if it is not installed; `package` would bring it."""
    try:
        return import_module(module)
    except ImportError as error:
        reason = f"{module} is not installed: pip install '{package}'"
        raise Missing(reason) from error


def dtype_of(batch: Params) -> np.dtype:
    """The dtype that the engine would choose."""
    return np.dtype(jnp.result_type(float, *jax.tree.leaves(batch)))


def packed(batch: Params) -> np.ndarray:
    """The batch as [field, N], scalars broadcast."""
    dtype = dtype_of(batch)
    leaves = [np.atleast_1d(np.asarray(getattr(batch, name), dtype)) for name in QUANTITIES]
    return np.ascontiguousarray(np.stack(np.broadcast_arrays(*leaves)))
