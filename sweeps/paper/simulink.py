"""The paper's algorithms as Simulink would run them: at the solver's stages, or once a step.

A function block with continuous inputs has no sample time. It runs at each evaluation of the
solver, or, if it holds its state for the step, once per accepted step:

- `stages`: Algorithm 2 at each of the four stages of ode4, Algorithm 1 once a step;
- `both at stages`: both algorithms at each stage;
- `RK23`, `RK45`, `ode23s`: both once per accepted step of a variable-step solver.

RK23 and RK45 control their steps as scipy's do; ode23s is the Rosenbrock method of Shampine and
Reichelt (1997), implicit as the paper's ode23t. All runs are in double precision (float64).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import RK23, RK45

from fic_jax import Model, Params, init
from fic_jax.controller import Attractor, torque
from fic_jax.environment import interaction_torque
from fic_jax.params import canonical
from fic_jax.rk4 import net_torque
from fic_jax.simulation import Memory, decide
from sweeps.paper.logs import T_END, Floats, Log

Clock = Literal["stages", "both at stages", "RK23", "RK45", "ode23s"]
CLOCKS: tuple[Clock, ...] = get_args(Clock)
LIMIT = T_END / 50  # s, the longest step: Simulink's default
FIRST = 1e-3  # s, the first step
ATOL = 1e-6  # rad, rad/s
SAFETY, LEAST, MOST = 0.9, 0.2, 10.0  # what the error estimate may make of a step
CHUNK = 1000  # attempts at a step in one compiled scan
MOST_CHUNKS = 40
LANES = 128  # runs in one program


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Run:
    """One run between two steps."""

    t: Any  # s
    y: Any  # (x, v), rad and rad/s
    measured: Any  # N*m, what Algorithm 2 reads next
    memory: Memory
    attractor: Attractor  # of the last step


def _begun(p: Params, x_h: jax.Array, model: Model) -> Run:
    """The start, with a first reference that is Algorithm 2's where x_h is NaN."""
    state = init(p, model)
    x, v, F = state.x, state.v, state.measured
    x_h = jnp.where(jnp.isnan(x_h), state.memory.x_h, x_h)
    memory = replace(state.memory, x_h=x_h, e_M=x_h - x)
    _, attractor = decide(p, memory, x, v, F, model, p.period)  # for its type
    return Run(jnp.zeros_like(x), jnp.stack([x, v]), F, memory, attractor)


def _decided(p: Params, run: Run, y: jax.Array, measured: jax.Array, model: Model) -> Run:
    """The run after Algorithms 1 and 2: with a period of one step, Algorithm 2 always ticks."""
    memory, attractor = decide(p, run.memory, y[0], y[1], measured, model, p.period)
    return replace(run, memory=memory, attractor=attractor)


def _slope(p: Params, run: Run, y: jax.Array, model: Model) -> jax.Array:
    """d(x, v)/dt at y, with the reference and the branch of the run."""
    tau = torque(run.memory.x_h - y[0], run.attractor, p)
    return jnp.stack([y[1], net_torque(p, tau, y[0], y[1], model) / p.I])


def _feedback(p: Params, run: Run, y: jax.Array, model: Model) -> jax.Array:
    """The torque that Algorithm 2 reads at y, N*m."""
    if model.feedback == "motor":
        return torque(run.memory.x_h - y[0], run.attractor, p)
    return interaction_torque(y[0], y[1], p, model)


def _moved(p: Params, run: Run, t: jax.Array, y: jax.Array, model: Model) -> Run:
    return replace(run, t=t, y=y, measured=_feedback(p, run, y, model))


def _row(p: Params, run: Run, model: Model) -> tuple[jax.Array, ...]:
    """The fields of a Log at the end of a step."""
    x, v = run.y
    diverging = run.attractor.diverging.astype(run.t.dtype)
    return run.t, x, v, interaction_torque(x, v, p, model), diverging


# --- ode4 ----------------------------------------------------------------------------------------


@partial(jax.jit, static_argnames=("model", "clock", "n"))
def _by_stages(
    p: Params, x_h: jax.Array, model: Model, clock: Clock, dt: jax.Array, n: int
) -> tuple[jax.Array, ...]:
    def one(p: Params, x_h: jax.Array) -> tuple[jax.Array, ...]:
        p = replace(p, period=dt)

        def decided(run: Run, y: jax.Array) -> Run:
            after = _decided(p, run, y, _feedback(p, run, y, model), model)
            if clock == "both at stages":
                return after
            memory = replace(run.memory, x_h=after.memory.x_h)
            return replace(run, memory=memory)

        def step(run: Run, k: jax.Array) -> tuple[Run, tuple[jax.Array, ...]]:
            y = run.y
            run = _decided(p, run, y, run.measured, model)
            k1 = _slope(p, run, y, model)
            run = decided(run, y2 := y + 0.5 * dt * k1)
            k2 = _slope(p, run, y2, model)
            run = decided(run, y3 := y + 0.5 * dt * k2)
            k3 = _slope(p, run, y3, model)
            run = decided(run, y4 := y + dt * k3)
            k4 = _slope(p, run, y4, model)
            y = y + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            run = _moved(p, run, k * dt, y, model)
            return run, _row(p, run, model)

        numbers = jnp.arange(1, n + 1, dtype=dt.dtype)
        return jax.lax.scan(step, _begun(p, x_h, model), numbers)[1]

    return jax.vmap(one)(p, x_h)


# --- solvers that choose their steps -------------------------------------------------------------

# An attempt: from y over h to (y after the step, its estimated error, y' after the step if known).
Attempt = Callable[[Callable[[jax.Array], jax.Array], jax.Array, jax.Array], tuple[jax.Array, ...]]


def _embedded(tableau: Any) -> Attempt:
    """An explicit Runge-Kutta pair of scipy: its coefficients A, B and E."""

    def attempt(
        slope: Callable[[jax.Array], jax.Array], y: jax.Array, h: jax.Array
    ) -> tuple[jax.Array, ...]:
        k = [slope(y)]
        for row in tableau.A[1:]:
            k.append(slope(y + h * sum(float(a) * b for a, b in zip(row, k, strict=False))))
        after = y + h * sum(float(b) * k_i for b, k_i in zip(tableau.B, k, strict=True))
        k.append(slope(after))
        return after, h * sum(float(e) * k_i for e, k_i in zip(tableau.E, k, strict=True))

    return attempt


def _ode23s(
    slope: Callable[[jax.Array], jax.Array], y: jax.Array, h: jax.Array
) -> tuple[jax.Array, ...]:
    """Shampine and Reichelt 1997, The MATLAB ODE Suite, eq. 8, for an autonomous system."""
    d, e32 = 1.0 / (2.0 + 2.0**0.5), 6.0 + 2.0**0.5
    W = jnp.eye(2) - h * d * jax.jacfwd(slope)(y)
    F0 = slope(y)
    k1 = _solved(W, F0)
    F1 = slope(y + 0.5 * h * k1)
    k2 = _solved(W, F1 - k1) + k1
    after = y + h * k2
    k3 = _solved(W, slope(after) - e32 * (k2 - F1) - 2.0 * (k1 - F0))
    return after, h / 6.0 * (k1 - 2.0 * k2 + k3)


def _solved(W: jax.Array, b: jax.Array) -> jax.Array:
    """W^-1 b of two unknowns, by Cramer's rule."""
    (p, q), (r, s) = W
    return jnp.stack([s * b[0] - q * b[1], p * b[1] - r * b[0]]) / (p * s - q * r)


ATTEMPTS: dict[Clock, tuple[Attempt, float]] = {  # and the exponent of its error
    "RK23": (_embedded(RK23), -1.0 / 3.0),
    "RK45": (_embedded(RK45), -1.0 / 5.0),
    "ode23s": (_ode23s, -1.0 / 3.0),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stepping:
    """A run, and the size of its next attempt at a step."""

    run: Run
    h: Any  # s
    rejected: Any  # bool, whether the last attempt was


def _by_steps(
    p: Params, x_h: jax.Array, model: Model, clock: Clock, rtol: jax.Array
) -> tuple[np.ndarray, ...]:
    """Rows of accepted steps, NaN for attempts that were rejected or came after the end."""
    stepping, parts = _first(p, x_h, model), []
    for _ in range(MOST_CHUNKS):
        stepping, rows = _attempts(p, stepping, model, clock, rtol)
        parts.append([np.asarray(row) for row in rows])
        if np.all(stepping.run.t >= T_END):
            break
    return tuple(np.concatenate(column, axis=1) for column in zip(*parts, strict=True))


@partial(jax.jit, static_argnames="model")
def _first(p: Params, x_h: jax.Array, model: Model) -> Stepping:
    def one(p: Params, x_h: jax.Array) -> Stepping:
        run = _begun(p, x_h, model)
        return Stepping(run, jnp.full_like(run.t, FIRST), jnp.zeros((), bool))

    return jax.vmap(one)(p, x_h)


@partial(jax.jit, static_argnames=("model", "clock"))
def _attempts(
    p: Params, stepping: Stepping, model: Model, clock: Clock, rtol: jax.Array
) -> tuple[Stepping, tuple[jax.Array, ...]]:
    """CHUNK attempts of each run: the steppings after them, and rows as of `_by_steps`."""
    attempt, exponent = ATTEMPTS[clock]

    def once(p: Params, before: Stepping) -> tuple[Stepping, tuple[jax.Array, ...]]:
        run, y, t = before.run, before.run.y, before.run.t
        held = _decided(p, run, y, run.measured, model)
        h = jnp.minimum(jnp.minimum(before.h, LIMIT), T_END - t)
        after, error = attempt(lambda y: _slope(p, held, y, model), y, h)
        scale = ATOL + rtol * jnp.maximum(jnp.abs(y), jnp.abs(after))
        norm = jnp.sqrt(jnp.mean((error / scale) ** 2))
        accepted = norm < 1.0
        by = SAFETY * jnp.maximum(norm, 1e-30) ** exponent
        most = jnp.where(accepted & ~before.rejected, MOST, 1.0)
        grown = h * jnp.clip(by, LEAST, most)
        ends = h >= T_END - t
        moved = _moved(p, held, jnp.where(ends, T_END, t + h), after, model)
        running = t < T_END
        new = Stepping(
            jax.tree.map(lambda a, b: jnp.where(accepted, a, b), moved, run), grown, ~accepted
        )
        new = jax.tree.map(lambda a, b: jnp.where(running, a, b), new, before)
        row = _row(p, moved, model)
        return new, tuple(jnp.where(accepted & running, value, jnp.nan) for value in row)

    def each(stepping: Stepping, _: None) -> tuple[Stepping, tuple[jax.Array, ...]]:
        return jax.vmap(once)(p, stepping)

    stepping, rows = jax.lax.scan(each, stepping, length=CHUNK)
    return stepping, tuple(jnp.swapaxes(row, 0, 1) for row in rows)


@partial(jax.jit, static_argnames="model")
def _start_rows(p: Params, x_h: jax.Array, model: Model) -> tuple[jax.Array, ...]:
    return jax.vmap(lambda p, x_h: _row(p, _begun(p, x_h, model), model))(p, x_h)


def logged(
    batch: Params,
    model: Model,
    clock: Clock,
    dt: float,
    rtol: float,
    x_h: Iterable[float] | None = None,
) -> Log:
    """Runs of 10 s of a batch of Params with [N] leaves.

    `dt` is the step of ode4 (s), `rtol` the relative tolerance of the solvers. `x_h` are first
    references (rad) in place of xd + Td/K0.
    """
    n = len(np.asarray(batch.K0))
    lanes = -(-n // LANES) * LANES  # padded by the last run: one program for every N
    filled = jax.tree.map(lambda leaf: np.pad(np.asarray(leaf), (0, lanes - n), "edge"), batch)
    begin = np.full(lanes, np.nan)
    if x_h is not None:
        begin[:n] = [*x_h]
    with jax.enable_x64(True):
        p, reference = canonical(filled), jnp.asarray(begin)
        first = _start_rows(p, reference, model)
        if clock in ATTEMPTS:
            rows = _by_steps(p, reference, model, clock, jnp.asarray(rtol))
        else:
            rows = _by_stages(p, reference, model, clock, jnp.asarray(dt), round(T_END / dt))
    return _packed([np.column_stack(pair)[:n] for pair in zip(first, rows, strict=True)])


def _packed(rows: list[Floats]) -> Log:
    """Rows without their gaps, padded to the longest."""
    kept = ~np.isnan(rows[0])
    longest = kept.sum(axis=1).max()
    order = np.argsort(~kept, axis=1, kind="stable")[:, :longest]
    return Log(*(np.take_along_axis(row, order, axis=1) for row in rows))
