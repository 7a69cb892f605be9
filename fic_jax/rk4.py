"""One plant step by classic RK4, Simulink's ode4: I x'' = torque - tau_env.

Branch, e_M and x_h are constant within the step. Each stage evaluates profile and contact at its
own x and v, so a switch within the step causes an error of first order (events.py locates it).
"""

from dataclasses import dataclass

import jax

from fic_jax.controller import Attractor, torque
from fic_jax.environment import interaction_torque
from fic_jax.params import Model, Params, Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Motion:
    """Position, velocity, and the controller's work in this plant step.

    Two other triples have this type: rates of change (rad/s, N*m for the velocity, W) and step
    sizes (s, s/(kg*m^2), s).
    """

    x: Scalar  # rad
    v: Scalar  # rad/s
    work: Scalar  # J


Stages = tuple[Motion, Motion, Motion, Motion]  # rates of change at RK4's four stages


def net_torque(
    p: Params, tau: Scalar, x: Scalar, v: Scalar, model: Model, side: Motion | None = None
) -> jax.Array:
    """I x'' = torque - tau_env, N*m; `side` as in `stages`."""
    x_v = None if side is None else (side.x, side.v)
    return tau - interaction_torque(x, v, p, model, x_v)


def step_sizes(p: Params, h: Scalar) -> Motion:
    """What multiplies the rates in a step of `h` seconds: h, and h/I for the velocity's rate I v'.

    A division by I at each stage would delay the next stage.
    """
    return Motion(h, h * (1.0 / p.I), h)


def stages(
    p: Params,
    start: Motion,
    x_h: Scalar,
    attractor: Attractor,
    model: Model,
    h: Scalar,
    side: Motion | None = None,
) -> Stages:
    """The rates of change k1..k4 over `h` seconds.

    `side` is the point that chooses the pieces of law and contact; by default each stage's own.
    """
    size = step_sizes(p, h)

    def rates(x: Scalar, v: Scalar) -> Motion:
        tau = torque(x_h - x, attractor, p, None if side is None else x_h - side.x)
        return Motion(v, net_torque(p, tau, x, v, model, side), tau * v)

    def after(part: float, k: Motion) -> Motion:
        return rates(start.x + part * size.x * k.x, start.v + part * size.v * k.v)

    k1 = rates(start.x, start.v)
    k2 = after(0.5, k1)
    k3 = after(0.5, k2)
    return k1, k2, k3, after(1.0, k3)


def end_of(start: Motion, stages: Stages, size: Motion) -> Motion:
    """The motion at the end of the step, to fourth order: start + h/6 (k1 + 2 k2 + 2 k3 + k4)."""

    def quadrature(y: Scalar, h: Scalar, k1: Scalar, k2: Scalar, k3: Scalar, k4: Scalar) -> Scalar:
        return y + (1.0 / 6.0) * h * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    return jax.tree.map(quadrature, start, size, *stages)


def advance(
    p: Params, start: Motion, x_h: Scalar, attractor: Attractor, model: Model, dt: Scalar
) -> Motion:
    """One plant step of `dt` seconds."""
    return end_of(start, stages(p, start, x_h, attractor, model, dt), step_sizes(p, dt))
