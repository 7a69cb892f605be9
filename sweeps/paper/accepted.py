"""A run whose steps the solver chooses: Algorithms 1 and 2 once per accepted step.

What happens to a recursion without a period of its own in a variable-step simulation, as the
paper's of contact (ode23t). The solvers are scipy's; `simulink` runs many at once with its own.
"""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from scipy.integrate import RK23, OdeSolver, Radau

from fic_jax import Model, Params, init
from fic_jax.controller import Attractor, torque
from fic_jax.environment import interaction_torque
from fic_jax.params import canonical
from fic_jax.rk4 import net_torque
from fic_jax.simulation import Memory, decide
from sweeps.paper.logs import T_END
from sweeps.paper.simulink import ATOL, LIMIT

TOLERANCE = {"rtol": 1e-3, "atol": ATOL}  # Simulink's relative default, and its absolute start
SOLVERS: dict[str, type[OdeSolver]] = {"Radau": Radau, "RK23": RK23}  # implicit as ode23t; explicit
MODEL = Model(contact="hard_stop")
MOST_STEPS = 20_000


def accepted_steps(
    p: Params, solver: type[OdeSolver], limit: float = LIMIT, first: float | None = None
) -> xr.Dataset:
    """A run with Algorithms 1 and 2 once per accepted step of a variable-step solver of scipy.

    `t` (s) and `tau_env` (N*m) over the steps k. Of the second half of the run: `tail`, nmse by the
    trapezoidal rule in time; `highest`, the largest torque, N*m; `rising`, by how much it rises.
    """
    with jax.enable_x64(True):
        t, tau_env = np.array(list(_rows(canonical(p), solver, limit, first))).T
    middle = float(np.interp(T_END / 2, t, tau_env))
    late = np.concatenate([[T_END / 2], t[t > T_END / 2]])
    eps = np.interp(late, t, tau_env) / float(p.Td) - 1.0
    return xr.Dataset(
        {
            "t": ("k", t),
            "tau_env": ("k", tau_env),
            "tail": np.trapezoid(eps**2, late) / (late[-1] - late[0]),
            "highest": tau_env[t > T_END / 2].max(),
            "rising": tau_env[-1] - middle,
        }
    )


def _rows(
    p: Params, solver: type[OdeSolver], limit: float, h: float | None
) -> Iterator[tuple[float, float]]:
    """Time and interaction torque after each step; the law is held for a step, as everywhere.

    `h` is the first step, s; None leaves it to the solver.
    """
    state = init(p, MODEL)
    memory, measured = state.memory, state.measured
    t, y = 0.0, np.array([float(p.x_init), float(p.v_init)])
    yield t, float(measured)
    for _ in range(MOST_STEPS):
        memory, attractor = _decided(p, memory, y, measured)
        slope = partial(_slope, p, memory.x_h, attractor)
        # A new solver for each step: the law it integrates is another one.
        run = solver(
            lambda _, y, slope=slope: np.asarray(slope(y)),
            t,
            y,
            T_END,
            max_step=limit,
            first_step=None if h is None else min(h, T_END - t),
            **TOLERANCE,
        )
        run.step()
        t, y, h = run.t, run.y, run.h_abs
        measured = _touch(p, y)
        yield t, float(measured)
        if run.status != "running":
            break


@jax.jit
def _decided(
    p: Params, memory: Memory, y: jax.Array, measured: jax.Array
) -> tuple[Memory, Attractor]:
    return decide(p, memory, y[0], y[1], measured, MODEL, p.period)  # a period a step: always ticks


@jax.jit
def _slope(p: Params, x_h: jax.Array, attractor: Attractor, y: jax.Array) -> jax.Array:
    tau = torque(x_h - y[0], attractor, p)
    return jnp.stack([y[1], net_torque(p, tau, y[0], y[1], MODEL) / p.I])


@jax.jit
def _touch(p: Params, y: jax.Array) -> jax.Array:
    return interaction_torque(y[0], y[1], p, MODEL)
