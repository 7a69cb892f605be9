"""The diffrax peer: a diffrax solver steps the plant under a scan, batched by vmap.

The controller changes its branch, e_M and x_h between plant steps and holds them during a step. The
scan therefore calls the solver's own `step`, as a diffrax user does for a controlled plant. diffrax
has no classic RK4; its Butcher tableau defines it.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers import installed, packed
from fic_jax import Metrics, Model, Params, State, init
from fic_jax.controller import torque
from fic_jax.environment import in_contact, interaction_torque
from fic_jax.events import Interval
from fic_jax.metrics import begin_tail, empty, finish, update
from fic_jax.piece import rounding
from fic_jax.rk4 import Motion
from fic_jax.simulation import decide

MODEL = Model()


def prepare(batch: Params, dt: float, n_steps: int, threads: int = 2) -> Callable[[], Metrics]:
    """Compile the batched loop. Raises Missing without diffrax.

    `threads` is not used: XLA itself distributes the one program of a CPU device.
    """
    solver, term = _solver(), installed("diffrax").ODETerm(_rates)
    columns = packed(batch)
    params = Params(*(jnp.asarray(column) for column in columns))
    step = columns.dtype.type(dt)

    def scenario(p: Params) -> Metrics:
        return _evaluate(p, jnp.asarray(step), n_steps, solver, term)

    compiled = jax.jit(jax.vmap(scenario)).lower(params).compile()
    return lambda: jax.tree.map(np.asarray, compiled(params))


@lru_cache
def _solver() -> Any:
    """Classic RK4 as a diffrax solver."""
    diffrax = installed("diffrax")
    tableau = diffrax.ButcherTableau(
        c=np.array([0.5, 0.5, 1.0]),
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
        b_error=np.zeros(4),  # the step is constant
    )

    class ClassicRK4(diffrax.AbstractERK):  # type: ignore[misc, name-defined]  # Any to mypy
        """Kutta's classic method of order 4."""

        tableau: ClassVar[Any]
        term_structure: ClassVar[Any] = diffrax.AbstractTerm
        interpolation_cls: ClassVar[Any] = diffrax.LocalLinearInterpolation  # not used

        def order(self, terms: Any) -> int:
            """Order of convergence."""
            return 4

    ClassicRK4.tableau = tableau
    return ClassicRK4()


def _rates(t: Any, y: Motion, held: Any) -> Motion:
    """d/dt of the motion and its integrals; the step holds the reference and the attractor."""
    p, x_h, attractor, dt = held
    tau = torque(x_h - y.x, attractor, p)
    tau_env = interaction_torque(y.x, y.v, p, MODEL)
    error = tau_env - p.Td
    return Motion(y.v, (tau - tau_env) / p.I, tau * y.v, error / dt, error**2 / dt)


def _evaluate(p: Params, dt: jax.Array, n_steps: int, solver: Any, term: Any) -> Metrics:
    """Metrics of one scenario."""
    tail, rest = n_steps // 2, rounding(p) * (dt / p.period)

    def body(carry: Any, k: jax.Array) -> tuple[Any, None]:
        state, acc = carry
        acc = jax.tree.map(lambda begun, on: jnp.where(k == tail, begun, on), begin_tail(acc), acc)
        memory, attractor = decide(p, state.memory, state.x, state.v, state.measured, MODEL, dt)
        y = Motion.at(state.x, state.v)
        held = (p, memory.x_h, attractor, dt)
        t = k.astype(dt.dtype) * dt
        start = solver.init(term, t, t + dt, y, held)
        y, _, _, _, _ = solver.step(term, t, t + dt, y, held, start, made_jump=False)
        tau_env, one = interaction_torque(y.x, y.v, p, MODEL), jnp.ones_like(y.x)
        interval = Interval(
            x=y.x,
            v=y.v,
            tau=torque(memory.x_h - y.x, attractor, p),
            T=tau_env,
            attractor=attractor,
            part=one,
            ends_step=jnp.array(True),
            work=y.work,
            error=y.error,
            square=y.square,
            highest=tau_env,
            lowest=tau_env,
            touches=in_contact(y.x, p, MODEL),
            since=one,
            way=jnp.abs(y.x - state.x),
        )
        state = State(k + 1, y.x, y.v, tau_env, memory)
        return (state, update(acc, interval, k, rest, p, MODEL)), None

    first = (init(p, MODEL), empty(p, MODEL))
    (state, acc), _ = jax.lax.scan(body, first, jnp.arange(n_steps, dtype=jnp.int32))
    return finish(acc, state.x, state.v, n_steps, tail, p, dt)
