"""One plant step of one scenario, a rollout of many steps, and the controller alone."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax.controller import (
    Attractor,
    Slopes,
    begin_branch,
    diverges,
    peak_error_after,
    torque,
)
from fic_jax.display import Displayed, Table, row
from fic_jax.environment import in_contact, interaction_torque
from fic_jax.events import PIECES, Interval, advance_to_switch
from fic_jax.exploration import expected_reference, explore
from fic_jax.inputs import (
    MAX_COUNT,
    ParamsError,
    Scalar,
    count,
    expect,
    real,
    shown,
    strong,
    transferred,
)
from fic_jax.lanes.hints import where_rare
from fic_jax.params import (
    Model,
    Params,
    canonical,
    check,
    check_model,
    check_scalars,
    check_step,
    of_one_type,
)
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
@dataclass(frozen=True, repr=False)
class Sample(Displayed):
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

    def _table(self) -> Table:
        return Table("Sample", [row(n, value, SIGNALS[n]) for n, value in vars(self).items()])


SIGNALS = {f.name: f.metadata for f in dataclasses.fields(Sample)}


def init(params: Params, model: Model = Model()) -> State:
    """The state before the first plant step: at x_init and v_init, with x_h = xd + Td/K0.

    The peak error is x_h - x_init: a joint that starts towards x_h has its peak behind it.

    Algorithm 2 ticks at the first step. It then reads tau_env of the initial state (`interaction`),
    or 0 N*m, as the motor has not acted (`motor`). Checks no values, but that they are real
    numbers (ParamsError).
    """
    check_model(model)
    return transferred(compiled_init, canonical(params), model=model)


def initial(p: Params, model: Model) -> State:
    """`init` on canonical numbers."""
    at_rest = jnp.zeros_like(p.x_init)
    measured = at_rest
    if model.feedback == "interaction":
        measured = interaction_torque(p.x_init, p.v_init, p, model)
    step_zero = jnp.zeros_like(p.x_init, jnp.int32)
    x_h = expected_reference(p)
    memory = Memory(x_h, x_h - p.x_init, at_rest, step_zero)
    return State(step_zero, p.x_init, p.v_init, measured, memory)


compiled_init = jax.jit(initial, static_argnames="model")


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
    return _remembered(memory, x_h, countdown - 1, attractor.e_M, e, attractor), attractor


def _remembered(
    last: Memory, x_h: Scalar, countdown: Scalar, e_M: Scalar, e: Scalar, attractor: Attractor
) -> Memory:
    slopes = None if last.slopes is None else attractor.slopes
    return Memory(x_h, e_M, jnp.abs(e), countdown, slopes)


def step_at_once(p: Params, state: State, model: Model, dt: Scalar) -> tuple[State, Interval]:
    """Explore, decide, advance, measure: a plant step of rk4, one interval."""
    memory, attractor = decide(p, state.memory, state.x, state.v, state.measured, model, dt)
    motion = advance(p, Motion.at(state.x, state.v), memory.x_h, attractor, model, dt)
    x, v, one = motion.x, motion.v, jnp.ones_like(motion.x)
    T = interaction_torque(x, v, p, model)
    interval = Interval(
        x=x,
        v=v,
        tau=torque(memory.x_h - x, attractor, p),
        T=T,
        attractor=attractor,
        part=one,
        ends_step=jnp.ones_like(x, bool),
        work=motion.work,
        error=motion.error,
        square=motion.square,
        highest=T,
        lowest=T,
        touches=in_contact(x, p, model),
        since=one,  # the end of its step
        way=jnp.abs(x - state.x),
    )
    return _after(state.k + 1, memory, interval, model), interval


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Progress:
    """How far a plant step with located switches has come."""

    passed: Scalar  # part of the step
    pieces: Scalar  # int32

    @classmethod
    def none(cls, like: Scalar) -> "Progress":
        """Between two plant steps."""
        return cls(jnp.zeros_like(like), jnp.zeros_like(like, jnp.int32))


def step_to_switch(
    p: Params, state: State, progress: Progress, model: Model, dt: Scalar
) -> tuple[State, Progress, Interval]:
    """Explore, decide, advance, measure up to the next switch, at most to the end of the step."""
    last = state.memory
    x_h, countdown = explore(last.x_h, last.countdown, state.x, state.measured, p, model, dt)
    e, e_M = x_h - state.x, last.e_M
    if model.divergence == "error_rate":  # by the tick; within a step the sign of e v decides
        e_M = jnp.where(diverges(e, state.v, last.e_last, model), e, e_M)
    final = progress.pieces >= PIECES - 1
    interval = advance_to_switch(
        p, state.x, state.v, x_h, e_M, last.slopes, progress.passed, final, model, dt
    )
    e, ends = x_h - interval.x, interval.ends_step
    countdown = countdown - ends.astype(jnp.int32)
    e_M = peak_error_after(interval.attractor, e)
    memory = _remembered(last, x_h, countdown, e_M, e, interval.attractor)
    progress = Progress(
        jnp.where(ends, 0.0, progress.passed + interval.part),
        jnp.where(ends, 0, progress.pieces + 1),
    )
    return _after(state.k + ends.astype(jnp.int32), memory, interval, model), progress, interval


def _after(k: Scalar, memory: Memory, interval: Interval, model: Model) -> State:
    measured = interval.T if model.feedback == "interaction" else interval.tau
    return State(k, interval.x, interval.v, measured, memory)


Seen = TypeVar("Seen")


def plant_step(
    p: Params,
    state: State,
    model: Model,
    dt: Scalar,
    see: Callable[[Seen, Interval], Seen],
    seen: Seen,
) -> tuple[State, Seen]:
    """The state after a plant step, and `seen = see(seen, interval)` for each of its intervals.

    `p` and `dt` are canonical (see `step`).
    """
    if model.integrator == "rk4":
        state, interval = step_at_once(p, state, model, dt)
        return state, see(seen, interval)

    def one(state: State, progress: Progress, seen: Seen) -> tuple[State, Progress, Seen]:
        state, progress, interval = step_to_switch(p, state, progress, model, dt)
        return state, progress, see(seen, interval)

    def next_interval(i: Scalar, carry: tuple[State, Progress, Seen]) -> Any:
        return where_rare((i == 0) | (carry[1].pieces > 0), partial(one, *carry), carry)

    # a loop: written out, the gradient takes minutes to compile
    start = state, Progress.none(state.x), seen
    state, _, seen = jax.lax.fori_loop(0, PIECES, next_interval, start)
    return state, seen


def sampled_step(p: Params, state: State, dt: Scalar, model: Model) -> tuple[State, Sample]:
    """The state after a plant step, and its signals."""
    none = jnp.zeros_like(state.x)

    def see(seen: Any, interval: Interval) -> Any:
        return seen[0] + interval.work, interval.attractor.diverging, interval.tau, interval.T

    nothing = none, jnp.ones_like(none, bool), none, none
    state, (work, diverging, tau, T) = plant_step(p, state, model, dt, see, nothing)
    memory, t = state.memory, state.k.astype(dt.dtype) * dt
    e = memory.x_h - state.x
    return state, Sample(t, state.x, state.v, memory.x_h, e, memory.e_M, diverging, tau, T, work)


compiled_step = jax.jit(sampled_step, static_argnames="model")


def canonical_with(params: Params, dt: Scalar, model: Model) -> tuple[Params, Scalar]:
    """Parameters and plant step in one strong dtype, before jit sees them. Raises ParamsError."""
    check_model(model)
    p = of_one_type("params", params)
    return p, strong(real("dt", dt), p.K0.dtype)


def checked(params: Params, dt: Scalar, n_steps: int, model: Model) -> tuple[Params, Scalar, int]:
    """`canonical_with`, after checking the values of one scenario. Raises ParamsError."""
    check_step(dt)
    p, canonical_dt = canonical_with(params, dt, model)
    check_scalars(p)
    check(p, dt)
    return p, canonical_dt, count("n_steps", n_steps)


def canonical_state(state: State, dtype: Any) -> State:
    """A state with the types that `init` gives it, for parameters of a float dtype."""
    expect("state", state, State, "init(params)")
    x, v, measured = (
        strong(real(name, getattr(state, name)), dtype) for name in ("x", "v", "measured")
    )
    memory = canonical_memory(state.memory, dtype)
    return State(_whole("k", state.k), x, v, measured, memory)


def canonical_memory(memory: Memory, dtype: Any) -> Memory:
    """A memory with the types that `init` gives it, for parameters of a float dtype."""
    expect("memory", memory, Memory, "init(params).memory")
    if memory.slopes is not None:
        expect("slopes", memory.slopes, Slopes, "None")
    x_h, e_M, e_last = (
        strong(real(name, getattr(memory, name)), dtype) for name in ("x_h", "e_M", "e_last")
    )
    return Memory(x_h, e_M, e_last, _whole("countdown", memory.countdown), memory.slopes)


def _whole(name: str, value: Any) -> Scalar:
    """A number of plant steps as int32."""
    number = real(name, value)
    if getattr(number, "dtype", np.dtype(float)).kind not in "iu":
        raise ParamsError(name, shown(value), "a whole number")
    if not isinstance(number, jax.Array) and not np.all((number >= 0) & (number < MAX_COUNT)):
        raise ParamsError(name, shown(value), f"from 0 to {MAX_COUNT - 1:,}")
    return strong(number, np.int32)


def step(
    params: Params, state: State, *, model: Model = Model(), dt: Scalar
) -> tuple[State, Sample]:
    """Advance one scenario by one plant step of `dt` seconds.

    The order is: explore (Algorithm 2, if it ticks), decide (Algorithm 1: branch and e_M), advance
    (RK4 on I x'' = torque - tau_env), measure. Arguments and results are scalars; vmap, scan, grad
    and the caller's jit apply. Parameters may change from step to step. Another `model` compiles
    again, other values do not. Checks no values, but that they are real numbers (ParamsError):
    `period` must be a whole multiple of `dt`.
    """
    p, dt = canonical_with(params, dt, model)
    state = canonical_state(state, dt.dtype)
    return transferred(compiled_step, p, state, dt, model=model)


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
    Checks no values, but that they are real numbers (ParamsError): `period` must be a whole
    multiple of `dt`.
    """
    p, dt = canonical_with(params, dt, model)
    memory = canonical_memory(memory, dt.dtype)
    measured = {"x": x, "v": v, "tau_measured": tau_measured}
    plant = [strong(real(name, value), dt.dtype) for name, value in measured.items()]
    return transferred(compiled_control, p, memory, *plant, dt, model=model)


@partial(jax.jit, static_argnames="model")
def compiled_control(
    p: Params, memory: Memory, x: Scalar, v: Scalar, measured: Scalar, dt: Scalar, model: Model
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
    p, dt, n_steps = checked(params, dt, n_steps, model)
    return transferred(compiled_rollout, p, dt, model=model, n_steps=n_steps)


@partial(jax.jit, static_argnames=("model", "n_steps"))
def compiled_rollout(p: Params, dt: Scalar, model: Model, n_steps: int) -> Sample:
    """`rollout` on canonical numbers."""
    start = with_slopes(p, initial(p, model))
    return stacked(lambda state: sampled_step(p, state, dt, model), start, n_steps)


def stacked(
    sample: Callable[[State], tuple[State, Sample]], start: State, n_samples: int
) -> Sample:
    """The samples of `n_samples` calls, each from the state that the last one returned.

    With the XLA flags of sweeps, each iteration of a scan copies all outputs so far: 10,000 samples
    of five scenarios took 1.4 s. So an inner scan has at most a hundred outputs.
    """
    inner = min(100, n_samples)
    outer = -(-n_samples // inner)

    def some(state: State, _: None) -> tuple[State, Sample]:
        return jax.lax.scan(lambda state, _: sample(state), state, length=inner)

    samples = jax.lax.scan(some, start, length=outer)[1]
    return jax.tree.map(lambda leaf: leaf.reshape(-1)[:n_samples], samples)
