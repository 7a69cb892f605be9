"""`where_rare`: a `jnp.where` that hints to the lane compiler which arm is rare."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

RARE = "where_rare"  # the name of the traced function, by which the compiler knows the hint


def where_rare(condition: Any, compute: Callable[[], Any], otherwise: Any) -> Any:
    """`jnp.where(condition, compute(), otherwise)`, of which the lane compiler may skip `compute`.

    `condition` is a bool scalar; `compute` takes no arguments and returns scalars in the structure
    and types of `otherwise` (a pytree). XLA and Pallas compute both arms, as with `jnp.where`: for
    finite gradients each arm has to be finite where the other one is chosen. The lane compiler
    skips the operations that only `compute` uses if no lane of a vector meets the condition. The
    bits of the result are the same.
    """

    def where_rare(condition: Any, otherwise: Any) -> Any:
        return jax.tree.map(lambda yes, no: jnp.where(condition, yes, no), compute(), otherwise)

    assert where_rare.__name__ == RARE
    if not isinstance(condition, jax.core.Tracer):  # nothing is compiled: no hint is needed
        return where_rare(condition, otherwise)
    return jax.jit(where_rare)(condition, otherwise)
