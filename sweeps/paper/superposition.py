"""Several controllers on one inertia, their gains constant or changing: motion and energy."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax import Model, Params, control, energy, init
from fic_jax.environment import interaction_torque

DT = 1e-3  # s, of controllers and plant alike
SLICE = 200  # steps that one value of a history covers
NO_TORQUE = 1e-9  # N*m, a Td that leaves the reference at xd; zero is none


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class History:
    """What a run shows, each value the largest of a slice of time; [runs, slices]."""

    swing: Any  # rad, |x|
    kinetic: Any  # J
    energy: Any  # J, kinetic and of all springs, each as it stores while diverging
    injected: Any  # J, what changes of gains have added to springs so far
    start: Any  # J, energy before the first step; [runs]


def simulate(
    gains: Params, body: Params, model: Model, seconds: float, substeps: int = 1
) -> History:
    """Runs of controllers with fixed references that act together on one inertia.

    `gains`: leaves [runs, steps of DT or 1, controllers], a controller rests on its xd. `body`:
    leaves [runs] of I, x_init, v_init, Kenv, Denv and gap; a hard stop. Controllers and plant take
    `substeps` steps in DT.
    """
    n_slices = round(seconds / DT / SLICE)
    return jax.tree.map(np.asarray, _simulator(model, n_slices, substeps)(gains, body))


def gains(**fields: np.ndarray) -> Params:
    """Params of controllers that only hold their reference; every leaf has the shape of K0."""
    shape = fields["K0"].shape
    silent = {"Td": NO_TORQUE, "sigma": 0.0, "period": DT}
    every = {name: float(v) for name, v in vars(Params()).items()} | silent
    leaves = {name: np.full((shape[0], 1, shape[2]), v) for name, v in every.items()}
    return Params(**(leaves | fields))


def bodies(n: int, **fields: np.ndarray) -> Params:
    """Params of n inertias, free unless `fields` say otherwise."""
    free = {name: np.full(n, float(v)) for name, v in vars(Params()).items()}
    free |= {"Kenv": np.zeros(n), "Denv": np.zeros(n)}
    return Params(**(free | fields))


@lru_cache(maxsize=64)
def _simulator(model: Model, n_slices: int, substeps: int) -> Any:
    """`simulate`, compiled for a model."""
    dt = DT / substeps

    def torques(p: Params, memory: Any, x: jax.Array, v: jax.Array, F: jax.Array) -> Any:
        return control(p, memory, x, v, F, model=model, dt=dt)

    together = jax.vmap(torques, in_axes=(0, 0, None, None, None))
    springs = jax.vmap(energy)

    def one(gains: Params, body: Params) -> History:
        def at(k: jax.Array) -> Params:
            row = k // substeps
            at = jax.tree.map(lambda leaf: leaf[jnp.clip(row, 0, leaf.shape[0] - 1)], gains)
            return replace(at, period=jnp.full_like(at.period, dt))

        def step(carry: Any, k: jax.Array) -> tuple[Any, Any]:
            memory, x, v, added = carry
            p = at(k)
            F = interaction_torque(x, v, body, model)
            tau, memory = together(p, memory, x, v, F)
            e = memory.x_h - x
            held = springs(e, p)
            added = added + jnp.sum(jnp.maximum(held - springs(e, at(k - 1)), 0.0))
            kinetic = 0.5 * body.I * v**2
            pressed = 0.5 * body.Kenv * jnp.maximum(x - body.gap, 0.0) ** 2
            H = kinetic + pressed + jnp.sum(held)
            v = v + dt * (jnp.sum(tau) - F) / body.I
            return (memory, x + dt * v, v, added), (jnp.abs(x), kinetic, H, added)

        def sliced(carry: Any, i: jax.Array) -> tuple[Any, Any]:
            steps = substeps * SLICE * i + jnp.arange(substeps * SLICE, dtype=jnp.int32)
            carry, seen = jax.lax.scan(step, carry, steps)
            return carry, (jax.tree.map(jnp.max, seen), seen[2][0])

        memory = jax.vmap(lambda p: init(p, model).memory)(at(jnp.int32(0)))
        start = memory, body.x_init, body.v_init, jnp.zeros_like(body.x_init)
        _, ((swing, kinetic, H, added), first) = jax.lax.scan(
            sliced, start, jnp.arange(n_slices, dtype=jnp.int32)
        )
        return History(swing, kinetic, H, added, first[0])

    return jax.jit(jax.vmap(one))
