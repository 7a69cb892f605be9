"""Algorithm 1: the fractal attractor, its memory and its torque."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from fic_jax.params import Model, Params, Scalar
from fic_jax.profile import bend, energy, force

REST_BAND = 0.01  # rad/s, below which `velocity_band` counts the joint as at rest


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Attractor:
    """The attractor as one plant step sees it: fixed while the step integrates."""

    diverging: jax.Array  # bool
    e_M: jax.Array  # rad, signed peak error
    energy_slope: jax.Array  # N*m/rad, 4 E_K(e_M)/e_M^2
    effort_slope: jax.Array  # N*m/rad, 2 F_K(e_M)/e_M


def departs(e: Scalar, v: Scalar, model: Model) -> jax.Array:
    """Whether the joint moves away from the reference, or rests, by its error and velocity."""
    away = e * v <= 0.0
    if model.divergence == "velocity_band":
        away = away | (jnp.abs(v) < REST_BAND)
    return away


def diverges(e: Scalar, v: Scalar, e_last: Scalar, model: Model) -> jax.Array:
    """Whether the coming plant step diverges (`Model.divergence`).

    `e_last` is |e| at the previous decision (rad); only `error_rate` reads it.
    """
    return jnp.abs(e) > e_last if model.divergence == "error_rate" else departs(e, v, model)


def latch(
    e: Scalar,
    diverging: Scalar,
    e_M: Scalar,
    p: Params,
    model: Model,
    relatched: Scalar | None = None,
) -> Attractor:
    """The attractor of a branch that begins at the error `e` (Algorithm 1, first half).

    While diverging, or where `relatched`, e_M follows e; while converging it is held (`latched`),
    or follows an error that is larger or of the other sign (`running`).
    """
    follow = diverging if relatched is None else diverging | relatched
    if model.peak == "running":
        follow = follow | (jnp.abs(e) > jnp.abs(e_M)) | (e * e_M < 0.0)
    e_M = jnp.where(follow, e, e_M)
    # In the linear zone both slopes are 2 K0, their limit at e_M = 0; a safe divisor keeps 0/0 out
    # of the branch not taken, and out of its gradient.
    linear = jnp.abs(e_M) <= p.x0
    per_e_M = 1.0 / jnp.where(linear, p.x0, e_M)
    energy_slope = jnp.where(linear, 2.0 * p.K0, 4.0 * energy(e_M, p) * per_e_M**2)
    effort_slope = jnp.where(linear, 2.0 * p.K0, 2.0 * force(e_M, p) * per_e_M)
    return Attractor(diverging, e_M, energy_slope, effort_slope)


def left_behind(attractor: Attractor, e: Scalar) -> jax.Array:
    """e_M (rad) after a motion under the attractor up to the error `e`."""
    return jnp.where(attractor.diverging, e, attractor.e_M)


def torque(
    e: Scalar,
    attractor: Attractor,
    p: Params,
    model: Model,
    side: Scalar | None = None,
) -> jax.Array:
    """Torque towards the reference, N*m, limited to +-Fmax (Algorithm 1, second half).

    Diverging: F_K(e). Converging: slope * (e - e_M/2), with the slope 4 E_K(e_M)/e_M^2
    where |e| <= x0 and 2 F_K(e_M)/e_M beyond (`algorithm1`), or one of them throughout.
    `side`, an error, chooses between the pieces in place of e.
    """
    side = e if side is None else side
    near, far = jnp.abs(side) <= p.x0, jnp.abs(side) >= p.xb
    within = attractor.effort_slope if model.law == "effort" else attractor.energy_slope
    beyond = attractor.energy_slope if model.law == "energy" else attractor.effort_slope
    # All but the bend between x0 and xb are straight lines: beyond xb, diverging, one so steep that
    # the limit makes +-Fmax of it (where e, unlike `side`, is not within x0/2).
    within = jnp.where(attractor.diverging, p.K0, within)
    beyond = jnp.where(attractor.diverging, 2.0 * p.Fmax / p.x0, beyond)
    centre = jnp.where(attractor.diverging, 0.0, 0.5 * attractor.e_M)
    straight = jnp.where(near, within, beyond) * (e - centre)
    tau = jnp.where(attractor.diverging & ~near & ~far, bend(e, p), straight)
    # where, not clip: XLA's minimum and maximum look for NaN first, which costs twice as much
    tau = jnp.where(tau < -p.Fmax, -p.Fmax, tau)
    return jnp.where(tau > p.Fmax, p.Fmax, tau)
