"""The force profile of the fractal attractor (eq. 1) and its energy (eq. 2)."""

import jax
import jax.numpy as jnp

from fic_jax.inputs import Scalar, real, strong, transferred
from fic_jax.lanes.hints import where_rare
from fic_jax.params import Params, of_one_type


def force(e: Scalar, p: Params) -> jax.Array:
    """Torque of the nonlinear spring (N*m) at the error `e` (rad): eq. 1, see `F_K`.

    `e` is a scalar, or an array that broadcasts with the leaves of `p`. Checks no values, but that
    they are real numbers (ParamsError).
    """
    p = of_one_type("p", p)
    return transferred(_compiled_force, strong(real("e", e), p.K0.dtype), p)


def energy(e: Scalar, p: Params) -> jax.Array:
    """Energy of the nonlinear spring (J) at the error `e` (rad): eq. 2, see `E_K`.

    `e` is a scalar, or an array that broadcasts with the leaves of `p`. Checks no values, but that
    they are real numbers (ParamsError).
    """
    p = of_one_type("p", p)
    return transferred(_compiled_energy, strong(real("e", e), p.K0.dtype), p)


def F_K(e: Scalar, p: Params) -> jax.Array:
    """Torque F_K of the nonlinear spring (N*m) at the error `e` (rad): eq. 1, odd in e.

        F_K = sgn(e) * { K0 |e|                                  |e| <= x0
                       { dF (1 - exp(-(|e| - x0)/b)) + K0 x0     x0 < |e| < xb
                       { Fmax                                    xb <= |e|

    with dF = Fmax - K0 x0 and b = (xb - x0)/S. At xb it jumps by dF exp(-S), 1e-8 N*m by default.
    If K0 x0 > Fmax, F_K exceeds Fmax between Fmax/K0 and xb; `controller.torque` limits it.
    """
    size = jnp.abs(e)
    linear, saturated = size <= p.x0, size >= p.xb
    straight = jnp.where(linear, p.K0 * e, jnp.where(e < 0.0, -p.Fmax, p.Fmax))
    # not `x0 < size < xb`: a NaN is in no piece, and takes the bend, which returns NaN
    return where_rare(~linear & ~saturated, lambda: _bend(e, p), straight)


def _bend(e: Scalar, p: Params) -> jax.Array:
    """F_K between x0 and xb."""
    magnitude = p.Fmax - (p.Fmax - p.K0 * p.x0) * _decay(jnp.abs(e), p)
    return jnp.where(e < 0.0, -magnitude, magnitude)


def _decay(e_abs: Scalar, p: Params) -> jax.Array:
    """exp(-(|e| - x0)/b), 1 below x0."""
    # where, not minimum: at |e| = x0 JAX's minimum halves the gradient
    beyond_x0 = jnp.where(e_abs < p.x0, 0.0, p.x0 - e_abs)
    return jnp.exp(beyond_x0 * (p.S / (p.xb - p.x0)))


def E_K(e: Scalar, p: Params) -> jax.Array:
    """Energy E_K of the nonlinear spring (J) at the error `e` (rad): eq. 2, dE_K/de = F_K.

        E_K = { K0 e^2 / 2                                                      |e| <= x0
              { Fmax (|e| - x0) + K0 x0^2 / 2 - b dF (1 - exp(-(m - x0)/b))     otherwise

    with m = min(|e|, xb), dF and b as in `F_K`. This is the integral of eq. 1; the printed
    eq. 2 has stray signs.
    """
    e_abs = jnp.abs(e)
    b = (p.xb - p.x0) / p.S
    dF = p.Fmax - p.K0 * p.x0
    decay = jnp.where(e_abs < p.xb, _decay(e_abs, p), jnp.exp(-p.S))
    beyond = p.Fmax * (e_abs - p.x0) + 0.5 * p.K0 * p.x0**2 - b * dF * (1.0 - decay)
    return jnp.where(e_abs <= p.x0, 0.5 * p.K0 * e**2, beyond)


_compiled_force, _compiled_energy = jax.jit(F_K), jax.jit(E_K)
