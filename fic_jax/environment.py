"""The environment: welded spring-damper, hard stop, damped rebound."""

import jax
import jax.numpy as jnp

from fic_jax.inputs import Scalar
from fic_jax.params import Model, Params


def in_contact(x: Scalar, p: Params, model: Model) -> jax.Array:
    """Whether the joint touches the environment at position x (rad); welded, it always does."""
    if model.contact == "welded":
        return jnp.ones_like(x, bool)
    return x >= p.gap


def interaction_torque(x: Scalar, v: Scalar, p: Params, model: Model) -> jax.Array:
    """Torque the joint exerts on the environment, tau_env in N*m.

        welded          Kenv (x - gap) + Denv v
        hard_stop       0 while x < gap, else Kenv (x - gap) + Denv max(v, 0)
        damped_rebound  0 while x < gap, else Kenv (x - gap) + Denv v

    The hard stop is Simscape's with undamped rebound: it does not pull.
    """
    rate = jnp.where(v > 0.0, v, 0.0) if model.contact == "hard_stop" else v
    pressed = p.Kenv * (x - p.gap) + p.Denv * rate
    return jnp.where(in_contact(x, p, model), pressed, 0.0)
