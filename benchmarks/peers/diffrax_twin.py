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
from fic_jax import Metrics, Model, Params, Sample, State, init
from fic_jax.controller import torque
from fic_jax.environment import interaction_torque
from fic_jax.metrics import empty, finish, update
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


def _rates(t: Any, y: Any, held: Any) -> Any:
    """d/dt of position, velocity and work; the step holds the reference and the attractor."""
    p, x_h, attractor = held
    x, v, _ = y
    tau = torque(x_h - x, attractor, p)
    return v, (tau - interaction_torque(x, v, p, MODEL)) / p.I, tau * v


def _evaluate(p: Params, dt: jax.Array, n_steps: int, solver: Any, term: Any) -> Metrics:
    """Metrics of one scenario."""

    def body(carry: Any, k: jax.Array) -> tuple[Any, None]:
        state, acc = carry
        memory, attractor = decide(p, state.memory, state.x, state.v, state.measured, MODEL, dt)
        y = (state.x, state.v, jnp.zeros_like(state.x))
        held = (p, memory.x_h, attractor)
        t = k.astype(dt.dtype) * dt
        start = solver.init(term, t, t + dt, y, held)
        y, _, _, _, _ = solver.step(term, t, t + dt, y, held, start, made_jump=False)
        x, v, work = y
        tau_env = interaction_torque(x, v, p, MODEL)
        e = memory.x_h - x
        tau = torque(e, attractor, p)
        sample = Sample(
            t + dt, x, v, memory.x_h, e, attractor.e_M, attractor.diverging, tau, tau_env, work
        )
        state = State(k + 1, x, v, tau_env, memory)
        return (state, update(acc, sample, k, n_steps, p, MODEL)), None

    first = (init(p, MODEL), empty(p))
    (state, acc), _ = jax.lax.scan(body, first, jnp.arange(n_steps, dtype=jnp.int32))
    return finish(acc, state.x, state.v, n_steps, p, dt)
