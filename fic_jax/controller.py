"""Algorithm 1: the branch, the peak error and the torque of the fractal attractor."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from fic_jax.inputs import Scalar
from fic_jax.lanes.hints import where_rare
from fic_jax.params import Model, Params
from fic_jax.profile import E_K, F_K

REST_BAND = 0.01  # rad/s, below which `velocity_band` counts the joint as at rest


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Slopes:
    """The slopes of a converging branch, and the peak error from which they were computed."""

    inner: Scalar  # N*m/rad, where |e| <= x0
    outer: Scalar  # N*m/rad, where |e| > x0
    e_M: Scalar  # rad


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Attractor:
    """The attractor within one plant step, or one segment of it: constant for its integration."""

    diverging: Scalar  # bool
    e_M: Scalar  # rad, signed peak error
    slopes: Slopes  # of a converging branch


def departs(e: Scalar, v: Scalar, model: Model) -> jax.Array:
    """Whether the joint moves away from the reference or rests: e v <= 0 (e in rad, v in rad/s)."""
    away = e * v <= 0.0
    if model.divergence == "velocity_band":
        away = away | (jnp.abs(v) < REST_BAND)
    return away


def diverges(e: Scalar, v: Scalar, e_last: Scalar, model: Model) -> jax.Array:
    """Whether the attractor diverges in this plant step (`Model.divergence`).

    `e_last` is |e| at the previous decision (rad); only `error_rate` uses it.
    """
    return jnp.abs(e) > e_last if model.divergence == "error_rate" else departs(e, v, model)


def peak_error(e: Scalar, diverging: Scalar, e_M: Scalar, model: Model) -> jax.Array:
    """The peak error e_M (rad) of a branch that begins at the error `e` (rad).

    Diverging: e_M becomes e. Converging: e_M stays (`latched`), or it becomes e if |e| is larger or
    e has the other sign (`running`).
    """
    follows = diverging
    if model.peak == "running":
        follows = follows | (jnp.abs(e) > jnp.abs(e_M)) | (e * e_M < 0.0)
    return jnp.where(follows, e, e_M)


def converging_slopes(e_M: Scalar, p: Params, model: Model) -> Slopes:
    """The slopes of the converging branch, N*m/rad, for the peak error `e_M` (`Model.law`).

        algorithm1    4 E_K(e_M)/e_M^2 where |e| <= x0, 2 F_K(e_M)/e_M beyond
        effort        2 F_K(e_M)/e_M everywhere
        energy        4 E_K(e_M)/e_M^2 everywhere

    In the linear zone, |e_M| <= x0, all of them equal 2 K0.
    """
    linear = jnp.abs(e_M) <= p.x0
    per_e_M = 1.0 / jnp.where(linear, p.x0, e_M)  # a safe divisor: no 0/0 in the gradient
    by_energy = jnp.where(linear, 2.0 * p.K0, 4.0 * E_K(e_M, p) * per_e_M**2)
    by_effort = jnp.where(linear, 2.0 * p.K0, 2.0 * F_K(e_M, p) * per_e_M)
    inner = by_effort if model.law == "effort" else by_energy
    outer = by_energy if model.law == "energy" else by_effort
    return Slopes(inner, outer, e_M)


def begin_branch(
    e: Scalar,
    diverging: Scalar,
    e_M: Scalar,
    p: Params,
    model: Model,
    known: Slopes | None = None,
) -> Attractor:
    """The attractor of a branch that begins at the error `e`, after the peak error `e_M` (rad).

    `known` are the slopes of the last converging branch. Slopes are computed only if the branch
    converges and `known` is for another e_M; a diverging branch uses none and passes `known` on.
    """
    e_M = peak_error(e, diverging, e_M, model)
    if known is None:
        return Attractor(diverging, e_M, converging_slopes(e_M, p, model))
    outdated = ~diverging & (e_M != known.e_M)
    slopes = where_rare(outdated, lambda: converging_slopes(e_M, p, model), known)
    return Attractor(diverging, e_M, slopes)


def peak_error_after(attractor: Attractor, e: Scalar) -> jax.Array:
    """e_M (rad) after a step that ends at the error `e`."""
    return jnp.where(attractor.diverging, e, attractor.e_M)


def torque(e: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """The controller's torque towards the reference (N*m), limited to +-Fmax (Algorithm 1)."""
    tau = unlimited_torque(e, attractor, p)
    # where, not clip: XLA's minimum and maximum look for NaN first, which costs twice as much
    tau = jnp.where(tau < -p.Fmax, -p.Fmax, tau)
    return jnp.where(tau > p.Fmax, p.Fmax, tau)


def unlimited_torque(e: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """The torque before its limit, N*m.

    diverging     F_K(e)
    converging    slope (e - e_M/2), with the inner slope where |e| <= x0, the outer beyond
    """
    slopes = attractor.slopes
    slope = jnp.where(jnp.abs(e) <= p.x0, slopes.inner, slopes.outer)
    return jnp.where(attractor.diverging, F_K(e, p), slope * (e - 0.5 * attractor.e_M))
