"""The force profile of the fractal attractor and its energy (eq. 1 and 2)."""

import jax
import jax.numpy as jnp

from fic_jax.lanes.hints import where_rare
from fic_jax.params import Params, Scalar


def force(e: Scalar, p: Params, side: Scalar | None = None) -> jax.Array:
    """Torque of the nonlinear spring, N*m, odd and continuous in the error `e` (rad).

        F_K = sgn(e) * { K0 |e|                                  |e| <= x0
                       { dF (1 - exp(-(|e| - x0)/b)) + K0 x0     x0 < |e| < xb
                       { Fmax                                    xb <= |e|

    with dF = Fmax - K0 x0 and b = (xb - x0)/S (eq. 1). It is not limited to Fmax: where
    K0 x0 > Fmax the profile overshoots between x0 and xb, and the controller limits its torque.
    `side`, an error, chooses the piece in place of `e`.
    """
    size = jnp.abs(e if side is None else side)
    linear, saturated = size <= p.x0, size >= p.xb
    straight = jnp.where(linear, p.K0 * e, jnp.where(e < 0.0, -p.Fmax, p.Fmax))
    # neither, not between: a NaN is in no piece, and the bend keeps it
    return where_rare(~linear & ~saturated, lambda: _bend(e, p), straight)


def _bend(e: Scalar, p: Params) -> jax.Array:
    """F_K between x0 and xb."""
    magnitude = p.Fmax - (p.Fmax - p.K0 * p.x0) * _decay(jnp.abs(e), p)
    return jnp.where(e < 0.0, -magnitude, magnitude)


def _decay(e_abs: Scalar, p: Params) -> jax.Array:
    """exp(-(|e| - x0)/b), 1 below x0."""
    # where, not minimum: at |e| = x0 that would pass on half the gradient only
    beyond_x0 = jnp.where(e_abs < p.x0, 0.0, p.x0 - e_abs)
    return jnp.exp(beyond_x0 * (p.S / (p.xb - p.x0)))


def energy(e: Scalar, p: Params) -> jax.Array:
    """Energy stored in the nonlinear spring, J, even in the error `e` (rad): dE/de = F_K.

        E_K = { K0 e^2 / 2                                                      |e| <= x0
              { Fmax (|e| - x0) + K0 x0^2 / 2 - b dF (1 - exp(-(m - x0)/b))     otherwise

    with m = min(|e|, xb). This is the integral of eq. 1; the printed eq. 2 has stray signs.
    """
    e_abs = jnp.abs(e)
    b = (p.xb - p.x0) / p.S
    dF = p.Fmax - p.K0 * p.x0
    decay = jnp.where(e_abs < p.xb, _decay(e_abs, p), jnp.exp(-p.S))
    beyond = p.Fmax * (e_abs - p.x0) + 0.5 * p.K0 * p.x0**2 - b * dF * (1.0 - decay)
    return jnp.where(e_abs <= p.x0, 0.5 * p.K0 * e**2, beyond)
