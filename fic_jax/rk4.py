"""One plant step by classic RK4, Simulink's ode4: I x'' = torque - tau_env.

Branch, e_M and x_h are constant within the step. Each stage evaluates profile and contact at its
own x and v, so a switch within the step causes an error of first order (events.py locates it).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from fic_jax.controller import Attractor, torque
from fic_jax.environment import interaction_torque
from fic_jax.inputs import Scalar
from fic_jax.params import Model, Params


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Motion:
    """Position and velocity, and the integrals over the plant step so far.

    RK4's rates of change and step sizes are Motions too.
    """

    x: Scalar  # rad
    v: Scalar  # rad/s
    work: Scalar  # J, of the controller
    error: Scalar  # N*m, mean of T - Td over the plant step; T is tau_env
    square: Scalar  # (N*m)^2, mean of (T - Td)^2

    @classmethod
    def at(cls, x: Scalar, v: Scalar) -> "Motion":
        """The start of a plant step."""
        none = jnp.zeros_like(x)
        return cls(x, v, none, none, none)


def net_torque(p: Params, tau: Scalar, x: Scalar, v: Scalar, model: Model) -> jax.Array:
    """I x'' = torque - tau_env, N*m."""
    return tau - interaction_torque(x, v, p, model)


def advance(
    p: Params, start: Motion, x_h: Scalar, attractor: Attractor, model: Model, dt: Scalar
) -> Motion:
    """One plant step of `dt` seconds. The integrals are states of the same RK4."""
    # What multiplies the rates. A division by I at each stage would delay the next stage.
    size = Motion(dt, dt * (1.0 / p.I), dt, 1.0, 1.0)

    def rates(x: Scalar, v: Scalar) -> Motion:
        tau = torque(x_h - x, attractor, p)
        tau_env = interaction_torque(x, v, p, model)
        error = tau_env - p.Td
        return Motion(v, tau - tau_env, tau * v, error, error**2)

    def after(part: float, k: Motion) -> Motion:
        return rates(start.x + part * size.x * k.x, start.v + part * size.v * k.v)

    k1 = rates(start.x, start.v)
    k2 = after(0.5, k1)
    k3 = after(0.5, k2)
    k4 = after(1.0, k3)

    def quadrature(y: Scalar, h: Scalar, k1: Scalar, k2: Scalar, k3: Scalar, k4: Scalar) -> Scalar:
        return y + (1.0 / 6.0) * h * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    return jax.tree.map(quadrature, start, size, k1, k2, k3, k4)
