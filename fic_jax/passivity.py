"""Passivity: the Lyapunov function V of the fractal attractor (the paper's appendix)."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from fic_jax.controller import Attractor
from fic_jax.inputs import Scalar
from fic_jax.params import Params
from fic_jax.profile import E_K


def potential(e: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """The potential U (J) of the torque in the attractor's branch: dU/de = `torque`, U(0) = 0.

    Diverging it is E_K (eq. 2), or if K0 x0 > Fmax the integral of the limited torque; converging
    it is E_AA (appendix). Between two switches U + I v^2/2 is constant.
    """
    # The profile exceeds Fmax from Fmax/K0 on if K0 x0 > Fmax: the limited torque has no curve.
    overshoots = p.K0 * p.x0 > p.Fmax
    U_K = jnp.where(overshoots, _cut(e, p.K0, p.Fmax), E_K(e, p))
    return jnp.where(attractor.diverging, U_K, _converging(e, attractor, p))


def _converging(e: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """U of the converging branch: slope `inner` where |e| <= x0, `outer` beyond."""
    inner = jnp.where(jnp.abs(e) <= p.x0, e, jnp.sign(e) * p.x0)
    middle = 0.5 * attractor.e_M

    def up_to(e: Scalar, slope: Scalar) -> jax.Array:
        return _cut(e - middle, slope, p.Fmax)

    near, far = attractor.slopes.inner, attractor.slopes.outer
    return up_to(inner, near) - up_to(jnp.zeros_like(e), near) + up_to(e, far) - up_to(inner, far)


def _cut(e: Scalar, slope: Scalar, Fmax: Scalar) -> jax.Array:
    """Integral from 0 to e of slope * e, limited to +-Fmax."""
    within = jnp.abs(slope * e) <= Fmax
    safe = jnp.where(within, 1.0, slope)
    return jnp.where(within, 0.5 * slope * e**2, Fmax * (jnp.abs(e) - 0.5 * Fmax / safe))


def stored(e: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """The attractor's part of V, J: U_K(e) diverging, U_AA(e) + E_C converging.

    E_C = U_K(e_M) - U_AA(e_M) makes both agree at the peak e_M (appendix). The appendix also
    requires E_C = -E_AA(0), that is V_AA(0) = 0. Both cannot hold: F_AA is odd about e_M/2, so E_AA
    is even about it and V_AA(0) = E_K(e_M). V falls by this when the convergence ends at e = 0.
    """
    diverging = replace(attractor, diverging=jnp.ones_like(attractor.diverging))
    U = potential(e, attractor, p)
    e_M = attractor.e_M
    E_C = potential(e_M, diverging, p) - potential(e_M, attractor, p)
    return U + jnp.where(attractor.diverging, 0.0, E_C)


def lyapunov(e: Scalar, v: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """The Lyapunov function V (J) of the appendix: kinetic energy and the attractor's energy.

        V_K  = I v^2/2 + E_K(e)           diverging
        V_AA = I v^2/2 + E_AA(e) + E_C    converging

    V is constant between switches while x_h is constant and no other torque acts on the joint.
    """
    return 0.5 * p.I * v**2 + stored(e, attractor, p)
