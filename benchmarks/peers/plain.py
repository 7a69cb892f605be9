"""The plain peer: what a JAX user would write, `jax.jit(jax.vmap(...))` of `fic_jax.evaluate`."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import fic_jax
from benchmarks.peers import packed
from fic_jax import Metrics, Params


def prepare(batch: Params, dt: float, n_steps: int, threads: int = 2) -> Callable[[], Metrics]:
    """Put the batch on the device; XLA compiles in the first run and does not use `threads`."""
    columns = Params(*(jnp.asarray(column) for column in packed(batch)))
    run = jax.jit(jax.vmap(lambda p: fic_jax.evaluate(p, dt=dt, n_steps=n_steps)))
    return lambda: jax.tree.map(np.asarray, run(columns))
