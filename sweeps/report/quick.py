"""Programs that compile in a fraction of a sweep's time and run slower: for many models, few runs.

A model is static, so that every reading is another program; what a sweep gains by an optimised
program it never earns back on some dozens of scenarios. Metrics and time histories come from one.
"""

import dataclasses
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax import Metrics, Model, Params, Sample, init
from fic_jax.metrics import empty, finish, update
from fic_jax.simulation import plant_step

# Unoptimised, XLA copies what a scan has put out so far at every turn: short inner scans.
INNER = 100
KEPT = ("t", "x", "tau_env")
Kept = tuple[jax.Array, jax.Array, jax.Array]
OPTIONS: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}


def simulate(batch: Params, model: Model, dt: float, n_steps: int) -> tuple[Metrics, Sample]:
    """Metrics [N] and time histories [N, n_steps] of scenarios with [N] leaves, on the host.

    Of the histories only t, x and tau_env are kept, what has to be copied; the rest is NaN.
    """
    program = _compiled(model, n_steps, len(batch.K0), np.result_type(batch.K0))
    metrics, kept = jax.tree.map(np.asarray, program(batch, np.asarray(dt, batch.K0.dtype)))
    nothing = dict.fromkeys(
        (f.name for f in dataclasses.fields(Sample)), np.full_like(kept[0], np.nan)
    )
    return metrics, Sample(**nothing | dict(zip(KEPT, kept, strict=True)))


@lru_cache(maxsize=8)
def _compiled(model: Model, n_steps: int, n: int, dtype: np.dtype) -> Any:
    def one(p: Params, dt: jax.Array) -> tuple[Metrics, Kept]:
        def step(carry: Any, k: jax.Array) -> tuple[Any, Kept]:
            state, acc = carry
            state, sample = plant_step(p, state, model, dt)
            acc = update(acc, sample, k, n_steps, p, model)
            return (state, acc), (sample.t, sample.x, sample.tau_env)

        def some(carry: Any, first: jax.Array) -> tuple[Any, Kept]:
            return jax.lax.scan(step, carry, first + jnp.arange(INNER, dtype=jnp.int32))

        firsts = jnp.arange(0, n_steps, INNER, dtype=jnp.int32)
        (state, acc), samples = jax.lax.scan(some, (init(p, model), empty(p)), firsts)
        t, x, tau_env = (leaf.reshape(n_steps) for leaf in samples)
        return finish(acc, state.x, state.v, n_steps, dt), (t, x, tau_env)

    leaf = jax.ShapeDtypeStruct((n,), dtype)
    fields = Params(**dict.fromkeys(vars(Params()), leaf))
    lowered = jax.jit(jax.vmap(one, in_axes=(0, None))).lower(
        fields, jax.ShapeDtypeStruct((), dtype)
    )
    return lowered.compile(compiler_options=OPTIONS)
