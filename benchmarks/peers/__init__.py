"""The default model as others would write it, each behind a `prepare` of the same face."""

from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax import QUANTITIES, Params


class Missing(Exception):  # noqa: N818  what is missing is no error of the program
    """Why a peer cannot run here, in one line."""


def installed(module: str) -> Any:
    """The module. Raises Missing if it cannot be imported."""
    try:
        return import_module(module)
    except ImportError as error:
        reason = f"{module} is not installed: pip install 'fic-jax[bench]'"
        raise Missing(reason) from error


def packed(batch: Params) -> np.ndarray:
    """The batch as [field, N] in the dtype the engine would choose; scalars broadcast."""
    dtype = np.dtype(jnp.result_type(float, *jax.tree.leaves(batch)))
    leaves = [np.atleast_1d(np.asarray(getattr(batch, name), dtype)) for name in QUANTITIES]
    return np.ascontiguousarray(np.stack(np.broadcast_arrays(*leaves)))
