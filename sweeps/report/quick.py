"""Programs that compile in a fraction of a sweep's time and run slower: for many models, few runs.

A model is static, so that every reading is another program; what a sweep gains by an optimised
program it never earns back on some dozens of scenarios. Metrics and time histories come from one.
"""

from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax import Metrics, Model, Params, Sample, init
from fic_jax.metrics import empty, finish, update
from fic_jax.simulation import plant_step

# Unoptimised, XLA copies all that a scan has put out so far at every turn: short inner scans.
INNER = 100
OPTIONS: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}


def simulate(
    batch: Params, model: Model, dt: float, n_steps: int, n_histories: int
) -> tuple[Metrics, Sample]:
    """Metrics [N] of scenarios with [N] leaves, and the first ones' histories [n, n_steps].

    `n_steps` is a multiple of INNER.
    """
    program = _compiled(model, n_steps, len(batch.K0), n_histories, np.result_type(batch.K0))
    return jax.tree.map(np.asarray, program(batch, np.asarray(dt, batch.K0.dtype)))


@lru_cache(maxsize=8)
def _compiled(model: Model, n_steps: int, n: int, n_histories: int, dtype: np.dtype) -> Any:
    each = partial(jax.vmap, in_axes=(0, 0, None, None))

    @each
    def step(p: Params, carry: Any, k: jax.Array, dt: jax.Array) -> tuple[Any, Sample]:
        state, acc = carry
        state, sample = plant_step(p, state, model, dt)
        return (state, update(acc, sample, k, n_steps, p, model)), sample

    def whole(batch: Params, dt: jax.Array) -> tuple[Metrics, Sample]:
        def one(carry: Any, k: jax.Array) -> tuple[Any, Sample]:
            carry, sample = step(batch, carry, k, dt)
            return carry, jax.tree.map(lambda leaf: leaf[:n_histories], sample)

        def some(carry: Any, first: jax.Array) -> tuple[Any, Sample]:
            return jax.lax.scan(one, carry, first + jnp.arange(INNER, dtype=jnp.int32))

        start = jax.vmap(lambda p: (init(p, model), empty(p)))(batch)
        firsts = jnp.arange(0, n_steps, INNER, dtype=jnp.int32)
        (state, acc), samples = jax.lax.scan(some, start, firsts)
        metrics = jax.vmap(lambda a, x, v: finish(a, x, v, n_steps, dt))(acc, state.x, state.v)
        return metrics, jax.tree.map(lambda leaf: leaf.reshape(n_steps, -1).T, samples)

    fields = Params(**dict.fromkeys(vars(Params()), jax.ShapeDtypeStruct((n,), dtype)))
    lowered = jax.jit(whole).lower(fields, jax.ShapeDtypeStruct((), dtype))
    return lowered.compile(compiler_options=OPTIONS)
