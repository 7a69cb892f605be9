"""One plant step of one scenario, and a rollout of many: where time advances."""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp

from fic_jax.controller import Attractor, diverges, latch, left_behind, torque
from fic_jax.environment import interaction_torque
from fic_jax.exploration import expected_reference, explore
from fic_jax.integration import Motion, advance, advance_located
from fic_jax.params import Model, Params, Scalar, canonical, check, check_scalars, strong


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Memory:
    """What the controller remembers from one control instant to the next."""

    x_h: Scalar  # rad, exploring reference (Algorithm 2)
    e_M: Scalar  # rad, signed peak error (Algorithm 1)
    e_last: Scalar  # rad, |e| at the last decision (rk4_events: at the end of the last step)
    countdown: Scalar  # plant steps until Algorithm 2 ticks, int32


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """One scenario between two plant steps."""

    k: Scalar  # plant steps taken, int32; time is k * dt, never summed
    x: Scalar  # rad
    v: Scalar  # rad/s
    measured: Scalar  # N*m, what Algorithm 2 will read (Model.feedback)
    memory: Memory


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sample:
    """What is measured at the end of plant step k, at time (k + 1) dt."""

    t: Scalar  # s
    x: Scalar  # rad
    v: Scalar  # rad/s
    x_h: Scalar  # rad, reference held in the step
    e: Scalar  # rad, x_h - x
    e_M: Scalar  # rad, peak error held in the step (rk4_events: at its end)
    diverging: Scalar  # bool, branch held in the step (rk4_events: at its end)
    torque: Scalar  # N*m, of the controller
    tau_env: Scalar  # N*m, on the environment
    work: Scalar  # J, done by the controller in the step


def init(params: Params, model: Model = Model()) -> State:
    """State before the first step: at x_init, v_init, with the reference at xd + Td/K0.

    Algorithm 2 first reads the torque of the initial state (`interaction`) or, the motor not
    having acted yet, zero (`motor`); it ticks at the first step.
    """
    p = canonical(params)
    at_rest = jnp.zeros_like(p.x_init)
    measured = at_rest
    if model.feedback == "interaction":
        measured = interaction_torque(p.x_init, p.v_init, p, model)
    step_zero = jnp.zeros_like(p.x_init, jnp.int32)
    memory = Memory(expected_reference(p), at_rest, at_rest, step_zero)
    return State(step_zero, p.x_init, p.v_init, measured, memory)


def decide(
    p: Params, memory: Memory, x: Scalar, v: Scalar, measured: Scalar, model: Model, dt: Scalar
) -> tuple[Memory, Attractor]:
    """Algorithm 2 if it ticks, then branch and peak error of Algorithm 1: what a step holds."""
    x_h, countdown = explore(memory.x_h, memory.countdown, x, measured, p, dt)
    e = x_h - x
    diverging = diverges(e, v, memory.e_last, model)
    attractor = latch(e, diverging, memory.e_M, p, model)
    return Memory(x_h, attractor.e_M, jnp.abs(e), countdown), attractor


def advanced(p: Params, state: State, model: Model, dt: Scalar) -> tuple[Memory, Attractor, Motion]:
    """Explore, decide and move by one plant step, with the integrator of `model`."""
    start = Motion(state.x, state.v, jnp.zeros_like(state.x))
    if model.integrator == "rk4":
        memory, attractor = decide(p, state.memory, state.x, state.v, state.measured, model, dt)
        return memory, attractor, advance(p, start, memory.x_h, attractor, model, dt)
    old = state.memory
    x_h, countdown = explore(old.x_h, old.countdown, state.x, state.measured, p, dt)
    motion, attractor = advance_located(p, start, x_h, old.e_M, old.e_last, model, dt)
    e = x_h - motion.x
    return Memory(x_h, left_behind(attractor, e), jnp.abs(e), countdown), attractor, motion


def plant_step(p: Params, state: State, model: Model, dt: Scalar) -> tuple[State, Sample]:
    """Explore, decide, advance, measure. `p` and `dt` are canonical (see `step`)."""
    memory, attractor, motion = advanced(p, state, model, dt)
    x, v = motion.x, motion.v
    e = memory.x_h - x
    tau = torque(e, attractor, p, model)
    tau_env = interaction_torque(x, v, p, model)
    measured = tau_env if model.feedback == "interaction" else tau
    k = state.k + 1
    t = k.astype(dt.dtype) * dt
    diverging = attractor.diverging
    sample = Sample(t, x, v, memory.x_h, e, memory.e_M, diverging, tau, tau_env, motion.work)
    return State(k, x, v, measured, memory), sample


def sampled(
    p: Params, state: State, model: Model, dt: Scalar, substeps: int
) -> tuple[State, Sample]:
    """`substeps` plant steps, together `dt` long, and the sample at the end of the last."""
    h = dt / substeps

    def one(state: State) -> tuple[State, Sample]:
        return plant_step(p, state, model, h)

    if substeps == 1:
        return one(state)

    def body(_: jax.Array, carry: tuple[State, Sample]) -> tuple[State, Sample]:
        state, sample = one(carry[0])
        return state, replace(sample, work=carry[1].work + sample.work)

    return jax.lax.fori_loop(1, substeps, body, one(state))


compiled_step = jax.jit(plant_step, static_argnames="model")


def canonical_with(params: Params, dt: Scalar) -> tuple[Params, Scalar]:
    """Parameters and plant step in one strong dtype, before jit sees them."""
    p = canonical(params)
    return p, strong(dt, p.K0.dtype)


def checked(params: Params, dt: Scalar, n_steps: int) -> tuple[Params, Scalar]:
    """`canonical_with`, of what one scenario may have. Raises ParamsError."""
    check_scalars(params)
    check(params, dt, n_steps)
    return canonical_with(params, dt)


def step(
    params: Params, state: State, *, model: Model = Model(), dt: Scalar
) -> tuple[State, Sample]:
    """Advance one scenario by one plant step of `dt` seconds.

    Order: Algorithm 2 if it ticks, branch and e_M (Algorithm 1), RK4, measurement. Scalars in,
    scalars out; composes with vmap, scan, grad and the caller's jit. Only a changed `model`
    compiles again. Nothing is checked here: `period` has to be a whole multiple of `dt`.
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
    """The controller alone, for somebody else's plant: torque (N*m) and the new memory.

    Jitted; call it once every `dt` seconds with the position x (rad), velocity v (rad/s) and
    measured torque (N*m); `init(params, model).memory` is the first memory. `Params.period` must
    be a multiple of `dt`. Of `params` only the controller's own fields are read, of `model` all
    but `contact` and `integrator`: the plant is yours.
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
    return torque(memory.x_h - x, attractor, p, model), memory


def rollout(params: Params, *, model: Model = Model(), dt: Scalar, n_steps: int) -> Sample:
    """Simulate one scenario from `init`; returns Sample with a leading time axis [n_steps].

    Raises ParamsError if a concrete value is out of bounds.
    """
    p, dt = checked(params, dt, n_steps)
    return compiled_rollout(p, model, dt, n_steps)


@partial(jax.jit, static_argnames=("model", "n_steps"))
def compiled_rollout(p: Params, model: Model, dt: Scalar, n_steps: int) -> Sample:
    """`rollout` on canonical numbers."""
    _, samples = jax.lax.scan(
        lambda state, _: plant_step(p, state, model, dt), init(p, model), length=n_steps
    )
    return samples
