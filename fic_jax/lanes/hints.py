"""A hint to the lane compiler, for code that stays free of branches everywhere else."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

RARE = "where_rare"  # the name of the traced function, by which the compiler knows the hint


def where_rare(condition: Any, compute: Callable[[], Any], otherwise: Any) -> Any:
    """`jnp.where(condition, compute(), otherwise)` for scalars or pytrees of them.

    Under jit, vmap, grad, XLA and Pallas both arms are computed, as with any `where`: each has to
    be finite where the other is taken. The lane compiler jumps over what `compute` alone needs
    where no lane meets the condition. The result is the same, bit for bit.

    `compute` takes no arguments and returns the structure of `otherwise`.
    """

    def where_rare(condition: Any, otherwise: Any) -> Any:
        return jax.tree.map(lambda yes, no: jnp.where(condition, yes, no), compute(), otherwise)

    assert where_rare.__name__ == RARE
    return jax.jit(where_rare)(condition, otherwise)
