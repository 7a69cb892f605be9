"""Programs that compile in a fraction of a sweep's time and run slower: for many models, few runs.

A model is static, so that every reading is another program; what a sweep gains by an optimised
program it never earns back on some dozens of scenarios. Metrics and time histories come from one,
and so do all numbers of steps.
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
INNER, OUTER = 100, 100
OPTIONS: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}


def simulate(
    batch: Params, model: Model, dt: float, n_steps: int, n_histories: int
) -> tuple[Metrics, Sample]:
    """Metrics [N] of scenarios with [N] leaves, and the first ones' histories [n, n_steps].

    `n_steps` is a multiple of INNER, at most INNER * OUTER.
    """
    dtype = np.result_type(batch.K0)
    program = _compiled(model, len(batch.K0), n_histories, dtype)
    metrics, samples = program(batch, np.asarray(dt, dtype), np.int32(n_steps))
    histories = jax.tree.map(lambda leaf: np.asarray(leaf)[:n_steps].T, samples)
    return jax.tree.map(np.asarray, metrics), histories


@lru_cache(maxsize=8)
def _compiled(model: Model, n: int, n_histories: int, dtype: np.dtype) -> Any:
    @partial(jax.jit, inline=True)  # traced once, for its types and for the loop
    @partial(jax.vmap, in_axes=(0, 0, None, None, None))
    def step(p: Params, carry: Any, k: Any, n_steps: Any, dt: Any) -> tuple[Any, Sample]:
        state, acc = carry
        state, sample = plant_step(p, state, model, dt)
        return (state, update(acc, sample, k, n_steps, p, model)), sample

    def whole(batch: Params, dt: jax.Array, n_steps: Any) -> tuple[Metrics, Sample]:
        def one(carry: Any, k: jax.Array) -> tuple[Any, Sample]:
            carry, sample = step(batch, carry, k, n_steps, dt)
            return carry, jax.tree.map(lambda leaf: leaf[:n_histories], sample)

        def some(i: jax.Array, carry: Any) -> Any:
            carry, kept = carry
            carry, new = jax.lax.scan(one, carry, i * INNER + jnp.arange(INNER, dtype=jnp.int32))
            return carry, jax.tree.map(lambda old, part: old.at[i].set(part), kept, new)

        start = jax.vmap(lambda p: (init(p, model), empty(p)))(batch)
        types = jax.eval_shape(one, start, jnp.zeros((), jnp.int32))[1]
        kept = jax.tree.map(lambda leaf: jnp.zeros((OUTER, INNER, *leaf.shape), leaf.dtype), types)
        (state, acc), kept = jax.lax.fori_loop(0, n_steps // INNER, some, (start, kept))
        metrics = jax.vmap(lambda a, x, v, p: finish(a, x, v, n_steps, p, dt))(
            acc, state.x, state.v, batch
        )
        return metrics, jax.tree.map(lambda leaf: leaf.reshape(OUTER * INNER, -1), kept)

    fields = Params(**dict.fromkeys(vars(Params()), jax.ShapeDtypeStruct((n,), dtype)))
    steps = jax.ShapeDtypeStruct((), np.dtype(np.int32))
    # `finish` divides by the number of steps, here an array of whole numbers
    with jax.numpy_dtype_promotion("standard"):
        lowered = jax.jit(whole).lower(fields, jax.ShapeDtypeStruct((), dtype), steps)
    return lowered.compile(compiler_options=OPTIONS)
