"""Passivity: the Lyapunov function of the fractal attractor, and the energy its switches absorb."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from fic_jax.controller import Attractor
from fic_jax.params import Params, Scalar
from fic_jax.profile import energy


def potential(e: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """Potential of the attractor's torque in its branch, J, 0 at e = 0: dU/de = `torque`.

    Diverging it is E_K (eq. 2), where K0 x0 > Fmax that of the torque cut off at Fmax; converging
    it is E_AA (appendix). Between two switches U + I v^2/2 is constant.
    """
    # Where the profile overshoots Fmax it does so from Fmax/K0 on, where the spring is linear.
    overshoots = p.K0 * p.x0 > p.Fmax
    U_K = jnp.where(overshoots, _cut(e, p.K0, p.Fmax), energy(e, p))
    return jnp.where(attractor.diverging, U_K, _converging(e, attractor, p))


def _converging(e: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """U of the converging branch: the torque's slope is one up to x0 and another beyond."""
    inner = jnp.where(jnp.abs(e) <= p.x0, e, jnp.sign(e) * p.x0)
    middle = 0.5 * attractor.e_M

    def up_to(e: Scalar, slope: Scalar) -> jax.Array:
        return _cut(e - middle, slope, p.Fmax)

    near, far = attractor.slopes.inner, attractor.slopes.outer
    return up_to(inner, near) - up_to(jnp.zeros_like(e), near) + up_to(e, far) - up_to(inner, far)


def _cut(e: Scalar, slope: Scalar, Fmax: Scalar) -> jax.Array:
    """Integral from 0 to e of slope * e, cut off at +-Fmax."""
    within = jnp.abs(slope * e) <= Fmax
    safe = jnp.where(within, 1.0, slope)
    return jnp.where(within, 0.5 * slope * e**2, Fmax * (jnp.abs(e) - 0.5 * Fmax / safe))


def stored(e: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """The attractor's part of V, J: U_K(e) diverging, U_AA(e) + E_C converging.

    E_C = U_K(e_M) - U_AA(e_M) makes both agree at the peak e_M (appendix). The appendix also asks
    E_C = -E_AA(0), so that V_AA(0) = 0; E_AA is even about e_M/2 where F_AA is odd, and then
    V_AA(0) = E_K(e_M): V falls by it when the convergence ends at e = 0.
    """
    diverging = replace(attractor, diverging=jnp.ones_like(attractor.diverging))
    U = potential(e, attractor, p)
    e_M = attractor.e_M
    E_C = potential(e_M, diverging, p) - potential(e_M, attractor, p)
    return U + jnp.where(attractor.diverging, 0.0, E_C)


def lyapunov(e: Scalar, v: Scalar, attractor: Attractor, p: Params) -> jax.Array:
    """V, J, of the appendix: kinetic energy and what the attractor has stored.

        V_K  = I v^2/2 + E_K(e)           diverging
        V_AA = I v^2/2 + E_AA(e) + E_C    converging

    Constant between switches while the reference rests and nothing else pushes the joint.
    """
    return 0.5 * p.I * v**2 + stored(e, attractor, p)
