"""The metrics of given samples, summed by the functions that a sweep uses."""

from functools import partial

import jax
import jax.numpy as jnp

from fic_jax.metrics import empty, finish, update


@partial(jax.jit, static_argnames="model")
def streamed(p, samples, dt, model):
    """Metrics of one scenario's samples; of the model only the contact is read."""
    n_steps = len(samples.x)

    def add(acc, step):
        return update(acc, *step, n_steps, p, model), None

    acc, _ = jax.lax.scan(add, empty(p), (samples, jnp.arange(n_steps, dtype=jnp.int32)))
    return finish(acc, samples.x[-1], samples.v[-1], n_steps, p, dt)
