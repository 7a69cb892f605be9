"""C11 to C13: the force profile, the Lyapunov function and the shape of the attractor."""

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from fic_jax import Model, Params, energy, force, rollout
from fic_jax.controller import begin_branch
from fic_jax.params import Law, canonical
from fic_jax.passivity import lyapunov, potential
from sweeps.paper.scenarios import Reading, grid, params, table

# --- C11 -----------------------------------------------------------------------------------------


def profile(_: Reading) -> pd.DataFrame:
    """`share`: F_K just below xb, over Fmax. The claim is about S = 20."""
    rows = grid(S=[2.0, 5.0, 7.0, 10.0, 20.0, 40.0], K0=[0.1, 1.0, 10.0, 100.0, 1000.0])
    p = Params(K0=rows.K0.to_numpy(), S=rows.S.to_numpy())
    below = np.full(len(rows), np.nextafter(p.xb, 0.0))
    share = np.asarray(force(below, p)) / p.Fmax
    return rows.assign(share=share, x0=p.x0, Fmax=p.Fmax, printed=rows.S == Params().S)


# --- C12 -----------------------------------------------------------------------------------------

PER_PEAK, STEPS = 400, 2400  # steps of a time e_M/speed; a cycle lasts less than 6 of them


def cycles(reading: Reading) -> pd.DataFrame:
    """`change` of V over V at the start, at four places of an unforced cycle from e = 0 and back.

    Within the diverging and the converging branch the largest change; at the switch at the peak
    and at the switch that ends the convergence the step.
    """
    return _cycles(reading.model.law)


@lru_cache
def _cycles(law: Law) -> pd.DataFrame:
    model = Model(law=law, integrator="rk4_events")
    # peaks in the linear zone, between x0 and xb, and saturated
    rows = grid(K0=[1.0, 100.0, 1000.0], e_M=[0.05, 0.104, 0.15, 0.3])
    K0, e_M = jnp.array(rows.K0), jnp.array(rows.e_M)
    free = table(Params(Kenv=0.0, Denv=0.0, sigma=0.0, Td=1e-9))
    p = replace(params(free.loc[[0] * len(rows)]), K0=K0)
    speed = jnp.sqrt(2.0 * jax.vmap(partial(_stored, model=model))(e_M, p) / p.I)
    dt = e_M / speed / PER_PEAK
    p = replace(p, v_init=-speed, xd=-p.Td / K0, period=dt)
    found = [_changes(*history) for history in zip(*_followed(p, dt, model), strict=True)]
    changes = pd.concat([rows, pd.DataFrame(found)], axis=1)
    places = changes.melt(["K0", "e_M"], var_name="place", value_name="change", ignore_index=False)
    return places.sort_index(kind="stable").reset_index(drop=True)


def _stored(e_M: jax.Array, p: Params, model: Model) -> jax.Array:
    """Energy that takes the diverging joint from e = 0 to e_M, J."""
    return potential(e_M, begin_branch(e_M, jnp.array(True), e_M, p, model), p)


def _followed(p: Params, dt: jax.Array, model: Model) -> tuple[np.ndarray, ...]:
    """V, e_M and whether the joint diverges, along each motion."""

    def one(p: Params, dt: jax.Array) -> tuple[jax.Array, ...]:
        motion = rollout(p, model=model, dt=dt, n_steps=STEPS)

        def V(s: Any) -> jax.Array:
            return lyapunov(s.e, s.v, begin_branch(s.e, s.diverging, s.e_M, p, model), p)

        return jax.vmap(V)(motion), motion.e_M, motion.diverging

    return tuple(np.asarray(column) for column in jax.jit(jax.vmap(one))(p, dt))


def _changes(V: np.ndarray, e_M: np.ndarray, diverging: np.ndarray) -> dict[str, float]:
    """Changes of V over the first cycle of a motion that begins diverging."""
    peak = int(np.argmax(~diverging))
    # it ends at e = 0, or where the joint turns short of it and latches a new peak
    end = peak + int(np.argmax((diverging | (e_M != e_M[peak]))[peak:]))
    out, back, after = V[:peak] / V[0], V[peak:end] / V[0], V[end] / V[0]
    return {
        "diverging": np.ptp(out),
        "peak": back[0] - out[-1],
        "converging": np.ptp(back),
        "end": after - back[-1],
    }


# --- C13 -----------------------------------------------------------------------------------------

SMALLEST = 0.01  # rad, peak error of the portrait that others are compared with
POINTS = 201  # of a portrait, from e = 0 to the peak


def portraits(reading: Reading) -> pd.DataFrame:
    """`distance` of scaled portraits, over the largest speed.

    With `gain` = 1 from the portrait of the smallest peak, otherwise, K0 and Fmax being multiplied
    by it, from that of the same peak with gain 1.
    """
    model = Model(law=reading.model.law)
    energies = grid(gain=[1.0], e_M=[0.05, 0.1, 0.102, 0.11, 0.15, 0.3])
    rows = pd.concat([energies, grid(gain=[0.1, 10.0], e_M=[0.05, 0.3])], ignore_index=True)

    def distance(row: Any) -> float:
        p, other = Params(), SMALLEST if row.gain == 1.0 else row.e_M
        scaled = replace(p, K0=row.gain * p.K0, Fmax=row.gain * p.Fmax)
        return abs(portrait(scaled, row.e_M, model) - portrait(p, other, model)).max()

    return rows.assign(distance=rows.apply(distance, axis=1), x0=Params().x0)


def portrait(p: Params, e_M: float, model: Model) -> np.ndarray:
    """Speeds over a cycle of peak e_M at POINTS errors from 0 to e_M, diverging then converging.

    Over sqrt(2 E_K(e_M)/I), the largest that the energy allows; 0 where the cycle does not get.
    """
    with jax.enable_x64(True):
        return np.asarray(_portrait(canonical(p), jnp.asarray(e_M), model))


@partial(jax.jit, static_argnames="model")
def _portrait(p: Params, e_M: jax.Array, model: Model) -> jax.Array:
    e = jnp.linspace(0.0, e_M, POINTS)

    def speeds(diverging: bool) -> jax.Array:
        attractor = begin_branch(e_M, jnp.array(diverging), e_M, p, model)
        U = jax.vmap(lambda e: potential(e, attractor, p))(e)
        return jnp.sqrt(jnp.maximum(U[-1] - U, 0.0) / energy(e_M, p))

    return jnp.concatenate([speeds(True), speeds(False)])
