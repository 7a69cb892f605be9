"""Algorithm 2: haptic exploration moves the reference until the torque is the desired one."""

import jax
import jax.numpy as jnp

from fic_jax.inputs import Scalar
from fic_jax.params import Model, Params, steps_per_period


def expected_reference(p: Params) -> Scalar:
    """The reference xd + Td/K0 (rad): on a rigid wall at xd it gives the torque Td."""
    return p.xd + p.Td / p.K0


def expects_contact(x: Scalar, p: Params, model: Model) -> jax.Array:
    """Whether the expected contact is still ahead at position x (rad); Algorithm 2's |x~| <= |xd|.

    x~ is the displacement x, or the error xd - x (`Model.expectation`).
    """
    distance = x if model.expectation == "displacement" else p.xd - x
    return jnp.abs(distance) <= jnp.abs(p.xd)


def explore(
    x_h: Scalar,
    countdown: Scalar,
    x: Scalar,
    measured: Scalar,
    p: Params,
    model: Model,
    dt: Scalar,
) -> tuple[jax.Array, jax.Array]:
    """The reference x_h (rad) of this plant step, and the plant steps up to the next tick.

    On a tick, with F = `measured` (N*m) and F != Td (Algorithm 2):
        x_h <- xd + Td/K0                              while it expects contact
        x_h <- x_h + (Td - F)/Td * sigma * Td/K0       afterwards
    Between ticks, and where F = Td, x_h stays.
    """
    ticks = countdown <= 0
    # (Td - F)/Td * Td/K0: Td cancels, and with it the division by a vanishing Td.
    searched = x_h + p.sigma / p.K0 * (p.Td - measured)
    target = jnp.where(expects_contact(x, p, model), expected_reference(p), searched)
    x_h = jnp.where(ticks & (measured != p.Td), target, x_h)
    return x_h, jnp.where(ticks, steps_per_period(p.period, dt), countdown)
