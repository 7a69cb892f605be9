"""One plant step of one scenario, a rollout of many steps, and the controller alone."""

import dataclasses
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from fic_jax.controller import (
    Attractor,
    Slopes,
    begin_branch,
    diverges,
    peak_error_after,
    torque,
)
from fic_jax.environment import in_contact, interaction_torque
from fic_jax.events import Events, advance_located
from fic_jax.exploration import expected_reference, explore
from fic_jax.params import Model, Params, Scalar, canonical, check, check_scalars, strong
from fic_jax.rk4 import Motion, advance


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Memory:
    """The controller's memory between two calls of `control`, or two plant steps (scalars)."""

    x_h: Scalar  # rad, exploring reference (Algorithm 2)
    e_M: Scalar  # rad, signed peak error (Algorithm 1)
    e_last: Scalar  # rad, |e| at the last decision (rk4_events: at the end of the last step)
    countdown: Scalar  # plant steps until Algorithm 2 ticks, int32
    # Of the converging branch, in a loop with constant parameters (`with_slopes`). None: each step
    # computes them from its own parameters.
    slopes: Slopes | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """One scenario between two plant steps (scalars)."""

    k: Scalar  # plant steps taken, int32; time is k * dt, not a sum
    x: Scalar  # rad
    v: Scalar  # rad/s
    measured: Scalar  # N*m, what Algorithm 2 will read (Model.feedback)
    memory: Memory


def _signal(unit: str, meaning: str) -> Any:
    return field(metadata={"unit": unit, "meaning": meaning})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sample:
    """The signals at the end of plant step k (from 0), time (k + 1) dt; scalars or [n_steps]."""

    t: Scalar = _signal("s", "time")
    x: Scalar = _signal("rad", "position")
    v: Scalar = _signal("rad/s", "velocity")
    x_h: Scalar = _signal("rad", "reference, constant in the step")
    e: Scalar = _signal("rad", "error x_h - x")
    e_M: Scalar = _signal("rad", "peak error in the step (rk4_events: at its end)")
    diverging: Scalar = _signal("1", "branch in the step (rk4_events: at its end), 1 if diverging")
    torque: Scalar = _signal("N*m", "torque of the controller")
    tau_env: Scalar = _signal("N*m", "torque on the environment")
    work: Scalar = _signal("J", "work done by the controller in the step")


SIGNALS = {f.name: f.metadata for f in dataclasses.fields(Sample)}


def init(params: Params, model: Model = Model()) -> State:
    """The state before the first plant step: at x_init and v_init, with x_h = xd + Td/K0.

    The peak error is x_h - x_init: a joint that starts towards x_h has its peak behind it.

    Algorithm 2 ticks at the first step. It then reads tau_env of the initial state (`interaction`),
    or 0 N*m, as the motor has not acted (`motor`). Checks no values.
    """
    p = canonical(params)
    at_rest = jnp.zeros_like(p.x_init)
    measured = at_rest
    if model.feedback == "interaction":
        measured = interaction_torque(p.x_init, p.v_init, p, model)
    step_zero = jnp.zeros_like(p.x_init, jnp.int32)
    x_h = expected_reference(p)
    memory = Memory(x_h, x_h - p.x_init, at_rest, step_zero)
    return State(step_zero, p.x_init, p.v_init, measured, memory)


def with_slopes(p: Params, state: State) -> State:
    """The state for a loop with constant parameters: slopes are computed once for each branch."""
    linear = 2.0 * p.K0  # for a peak error of 0
    slopes = Slopes(linear, linear, jnp.zeros_like(p.x_init))
    return replace(state, memory=replace(state.memory, slopes=slopes))


def decide(
    p: Params, memory: Memory, x: Scalar, v: Scalar, measured: Scalar, model: Model, dt: Scalar
) -> tuple[Memory, Attractor]:
    """Explore (Algorithm 2), then choose branch and peak error (Algorithm 1) for this step."""
    x_h, countdown = explore(memory.x_h, memory.countdown, x, measured, p, model, dt)
    e = x_h - x
    diverging = diverges(e, v, memory.e_last, model)
    attractor = begin_branch(e, diverging, memory.e_M, p, model, memory.slopes)
    return _remembered(memory, x_h, countdown, attractor.e_M, e, attractor), attractor


def _remembered(
    last: Memory, x_h: Scalar, countdown: Scalar, e_M: Scalar, e: Scalar, attractor: Attractor
) -> Memory:
    slopes = None if last.slopes is None else attractor.slopes
    return Memory(x_h, e_M, jnp.abs(e), countdown, slopes)


def plant_step(
    p: Params, state: State, model: Model, dt: Scalar
) -> tuple[State, Sample, Motion, Events]:
    """Explore, decide, advance, measure. `p` and `dt` are canonical (see `step`).

    Also returns the integrals over the step and its events, for the metrics.
    """
    k, start = state.k + 1, Motion.at(state.x, state.v)
    if model.integrator == "rk4":
        memory, attractor = decide(p, state.memory, state.x, state.v, state.measured, model, dt)
        motion = advance(p, start, memory.x_h, attractor, model, dt)
        state, sample = _measure(p, k, memory, attractor, motion, model, dt)
        return state, sample, motion, _at_its_end(p, attractor, sample, model)
    memory, attractor, motion, events = _decide_and_advance_located(p, state, start, model, dt)
    state, sample = _measure(p, k, memory, attractor, motion, model, dt)
    return state, sample, motion, events


def _decide_and_advance_located(
    p: Params, state: State, start: Motion, model: Model, dt: Scalar
) -> tuple[Memory, Attractor, Motion, Events]:
    """`decide` and advance in one: each piece of a located step decides its own branch."""
    last = state.memory
    x_h, countdown = explore(last.x_h, last.countdown, state.x, state.measured, p, model, dt)
    e, e_M = x_h - state.x, last.e_M
    if model.divergence == "error_rate":  # by the tick; within a step the sign of e v decides
        e_M = jnp.where(diverges(e, state.v, last.e_last, model), e, e_M)
    motion, events, attractor = advance_located(p, start, x_h, e_M, last.slopes, model, dt)
    e = x_h - motion.x
    e_M = peak_error_after(attractor, e)
    return _remembered(last, x_h, countdown, e_M, e, attractor), attractor, motion, events


def _at_its_end(p: Params, attractor: Attractor, sample: Sample, model: Model) -> Events:
    """The events of a step that is seen at its end only."""
    touches = in_contact(sample.x, p, model).astype(sample.x.dtype)
    none = jnp.zeros_like(touches, jnp.int32)
    T, whole = sample.tau_env, jnp.ones_like(touches)
    return Events(attractor.diverging, T, T, contact=touches, touch=whole, switches=none)


def _measure(
    p: Params,
    k: Scalar,
    memory: Memory,
    attractor: Attractor,
    motion: Motion,
    model: Model,
    dt: Scalar,
) -> tuple[State, Sample]:
    """The state after plant step k (counted from 1), and its signals."""
    x, v = motion.x, motion.v
    e = memory.x_h - x
    tau, tau_env = torque(e, attractor, p), interaction_torque(x, v, p, model)
    measured = tau_env if model.feedback == "interaction" else tau
    t = k.astype(dt.dtype) * dt
    diverging = attractor.diverging
    sample = Sample(t, x, v, memory.x_h, e, memory.e_M, diverging, tau, tau_env, motion.work)
    return State(k, x, v, measured, memory), sample


@partial(jax.jit, static_argnames="model")
def compiled_step(p: Params, state: State, model: Model, dt: Scalar) -> tuple[State, Sample]:
    """`step` on canonical numbers."""
    return plant_step(p, state, model, dt)[:2]


def canonical_with(params: Params, dt: Scalar) -> tuple[Params, Scalar]:
    """Parameters and plant step in one strong dtype, before jit sees them."""
    p = canonical(params)
    return p, strong(dt, p.K0.dtype)


def checked(params: Params, dt: Scalar, n_steps: int) -> tuple[Params, Scalar]:
    """`canonical_with`, after checking the values of one scenario. Raises ParamsError."""
    check_scalars(params)
    check(params, dt, n_steps)
    return canonical_with(params, dt)


def step(
    params: Params, state: State, *, model: Model = Model(), dt: Scalar
) -> tuple[State, Sample]:
    """Advance one scenario by one plant step of `dt` seconds.

    The order is: explore (Algorithm 2, if it ticks), decide (Algorithm 1: branch and e_M), advance
    (RK4 on I x'' = torque - tau_env), measure. Arguments and results are scalars; vmap, scan, grad
    and the caller's jit apply. Parameters may change from step to step. Another `model` compiles
    again, other values do not. Checks no values: `period` must be a whole multiple of `dt`.
    """
    p, dt = canonical_with(params, dt)
    return compiled_step(p, state, model, dt)


def control(
    params: Params,
    memory: Memory,
    x: Scalar,
    v: Scalar,
    tau_measured: Scalar,
    *,
    model: Model = Model(),
    dt: Scalar,
) -> tuple[jax.Array, Memory]:
    """The controller without a plant: its torque (N*m) and its new memory (Algorithms 1 and 2).

    Call it once every `dt` seconds with the position x (rad), the velocity v (rad/s) and the
    measured torque (N*m) of your plant, all scalars. The first memory is
    `init(params, model).memory`. It uses no field of `params` that describes inertia, environment
    or initial state, and neither `contact` nor `integrator` of `model`. Compiled by jax.jit.
    Checks no values: `period` must be a whole multiple of `dt`.
    """
    p, dt = canonical_with(params, dt)
    x, v, tau_measured = (strong(a, dt.dtype) for a in (x, v, tau_measured))
    return compiled_control(p, memory, x, v, tau_measured, model, dt)


@partial(jax.jit, static_argnames="model")
def compiled_control(
    p: Params, memory: Memory, x: Scalar, v: Scalar, measured: Scalar, model: Model, dt: Scalar
) -> tuple[jax.Array, Memory]:
    """`control` on canonical numbers."""
    memory, attractor = decide(p, memory, x, v, measured, model, dt)
    return torque(memory.x_h - x, attractor, p), memory


def rollout(params: Params, *, model: Model = Model(), dt: Scalar, n_steps: int) -> Sample:
    """Simulate one scenario from `init` over `n_steps` plant steps of `dt` seconds.

    Takes Params with scalar leaves; returns Sample with leaves [n_steps]. The order of a step is
    that of `step`. vmap, grad and the caller's jit apply.

    Raises ParamsError if a value is out of bounds. Values under the caller's jit or vmap are not
    checked.
    """
    p, dt = checked(params, dt, n_steps)
    return compiled_rollout(p, model, dt, n_steps)


@partial(jax.jit, static_argnames=("model", "n_steps"))
def compiled_rollout(p: Params, model: Model, dt: Scalar, n_steps: int) -> Sample:
    """`rollout` on canonical numbers."""
    start = with_slopes(p, init(p, model))
    _, samples = jax.lax.scan(
        lambda state, _: plant_step(p, state, model, dt)[:2], start, length=n_steps
    )
    return samples
