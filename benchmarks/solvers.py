"""nmse of one scenario by other solvers: diffrax with constant and adaptive steps, scipy.

Each is written as a user of that library would simulate a controller with a period of 10 ms:
Algorithm 2 acts between two solves, and a solve holds its reference.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from benchmarks.scenarios import N_SAMPLES, PERIOD
from fic_jax import QUANTITIES, Model, Params, init
from fic_jax.controller import torque
from fic_jax.environment import interaction_torque
from fic_jax.events import enter
from fic_jax.exploration import expected_reference, explore
from fic_jax.metrics import reachable
from fic_jax.rk4 import Motion
from fic_jax.simulation import decide
from tests.reference import events

Scenario = Callable[[Params], jax.Array]
MOST_STEPS = 4096  # of the solver in one period
MOST_SEGMENTS = 20  # of smooth motion in one period


def constant_steps(model: Model, substeps: int) -> Scenario:
    """Tsit5 with `substeps` steps per period; Algorithm 1 sets branch and e_M before each step."""
    solver, term = diffrax.Tsit5(), diffrax.ODETerm(_held)
    h = jnp.asarray(PERIOD / substeps)

    def one(p: Params) -> jax.Array:
        def step(state: Any, _: None) -> tuple[Any, None]:
            x, v, measured, memory = state
            memory, attractor = decide(p, memory, x, v, measured, model, h)
            args = (p, memory.x_h, attractor, model)
            t = jnp.zeros_like(h)
            start = solver.init(term, t, h, (x, v), args)
            moved = solver.step(term, t, h, (x, v), args, start, made_jump=False)
            x, v = moved[0]
            return (x, v, interaction_torque(x, v, p, model), memory), None

        def sample(carry: Any, _: None) -> tuple[Any, None]:
            state, total = carry
            state = jax.lax.scan(step, state, length=substeps)[0]
            return (state, total + _square(p, state[2])), None

        s = init(p, model)
        start = ((s.x, s.v, s.measured, s.memory), jnp.zeros_like(s.x))
        (_, total), _ = jax.lax.scan(sample, start, length=N_SAMPLES)
        return total / N_SAMPLES

    return one


def adaptive_with_events(model: Model, rtol: float) -> Scenario:
    """Tsit5 with a PI step-size controller, tolerance `rtol`.

    A solve ends at the next control period or at a switch, which is an Event. Without events, the
    branch would follow from the state, with e_M as a third state: the motion would slide along
    v = 0, where Algorithm 1 sets a new e_M, and the steps would become tiny. With the flags of
    `tune_for_throughput`, XLA ends the process on this program (jaxlib 0.10.2).
    """
    solver, term = diffrax.Tsit5(), diffrax.ODETerm(_piece)
    controller = diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol, pcoeff=0.3, icoeff=0.4)
    event = diffrax.Event(
        (_to_turn, _to_error, _to_saturation, _to_gap),
        optimistix.Newton(rtol=1e-3 * rtol, atol=1e-6 * rtol),
        direction=(False,) * 4,
    )

    def one(p: Params) -> jax.Array:
        def segment(carry: Any) -> Any:
            t, x, v, e_M, x_h, count = carry
            start = Motion(x, v, jnp.zeros_like(x))
            attractor, side = enter(p, start, x_h, e_M, jnp.array(False), None, model, PERIOD)
            solution = diffrax.diffeqsolve(
                term,
                solver,
                t0=t,
                t1=PERIOD,
                dt0=PERIOD - t,
                y0=(x, v),
                args=(p, x_h, attractor, side, model),
                stepsize_controller=controller,
                max_steps=MOST_STEPS,
                throw=False,
                event=event,
            )
            turned = solution.event_mask[0]
            x, v = (leaf[0] for leaf in solution.ys)
            v = jnp.where(turned, 0.0, v)
            e_M = jnp.where(attractor.diverging, x_h - x, attractor.e_M)
            return solution.ts[0], x, v, e_M, x_h, count + 1

        def goes_on(carry: Any) -> jax.Array:
            return (carry[0] < PERIOD) & (carry[-1] < MOST_SEGMENTS)

        def sample(carry: Any, _: None) -> tuple[Any, None]:
            (x, v, e_M, x_h), total = carry
            none = jnp.zeros_like(x, jnp.int32)
            x_h = explore(x_h, none, x, interaction_torque(x, v, p, model), p, model, PERIOD)[0]
            first = (jnp.zeros_like(x), x, v, e_M, x_h, none)
            x, v, e_M, x_h = jax.lax.while_loop(goes_on, segment, first)[1:5]
            total = total + _square(p, interaction_torque(x, v, p, model))
            return ((x, v, e_M, x_h), total), None

        rest = jnp.zeros_like(p.x_init)
        start = ((p.x_init, p.v_init, rest, expected_reference(p)), rest)
        (_, total), _ = jax.lax.scan(sample, start, length=N_SAMPLES)
        return total / N_SAMPLES

    return one


def _piece(t: Any, y: Any, args: Any) -> Any:
    """x' and v' on the smooth piece of law and contact that `side` lies in."""
    p, x_h, attractor, side, model = args
    x, v = y
    tau = torque(x_h - x, attractor, p, x_h - side.x)
    return v, (tau - interaction_torque(x, v, p, model, (side.x, side.v))) / p.I


def _ahead(value: jax.Array, side: jax.Array) -> jax.Array:
    """Distance to the switch at 0, positive on the side where the motion starts."""
    return jnp.where(side > 0.0, value, -value)


def _to_turn(t: Any, y: Any, args: Any, **_: Any) -> Any:
    return _ahead(y[1], args[3].v)


def _to_error(t: Any, y: Any, args: Any, **_: Any) -> Any:
    return _ahead(args[1] - y[0], args[1] - args[3].x)


def _to_saturation(t: Any, y: Any, args: Any, **_: Any) -> Any:
    p, x_h, _, side, _ = args
    return _ahead(jnp.abs(x_h - y[0]) - p.x0, jnp.abs(x_h - side.x) - p.x0)


def _to_gap(t: Any, y: Any, args: Any, **_: Any) -> Any:
    p, _, _, side, model = args
    return (
        jnp.ones_like(y[0]) if model.contact == "welded" else _ahead(y[0] - p.gap, side.x - p.gap)
    )


def _held(t: Any, y: Any, args: Any) -> Any:
    """x' and v' with constant branch and e_M."""
    p, x_h, attractor, model = args
    x, v = y
    return v, (torque(x_h - x, attractor, p) - interaction_torque(x, v, p, model)) / p.I


def _square(p: Params, tau_env: jax.Array) -> jax.Array:
    return ((tau_env - p.Td) / reachable(p)) ** 2


def located_by_scipy(p: Params, model: Model, rtol: float) -> float:
    """scipy's DOP853; every switch is an event (tests/reference/events.py).

    Raises Irregular if short steps do not converge.
    """
    choices: dict[str, str] = {
        "law": model.law,
        "divergence": model.divergence,
        "peak": model.peak,
        "feedback": model.feedback,
        "contact": model.contact,
    }
    plain = {name: float(getattr(p, name)) for name in QUANTITIES}
    times = PERIOD * np.arange(1, N_SAMPLES + 1)
    before = events.RTOL, events.ATOL
    events.RTOL, events.ATOL = rtol, 1e-2 * rtol
    try:
        tau_env = events.simulate(plain, choices, N_SAMPLES * PERIOD, times)["tau_env"]
    finally:
        events.RTOL, events.ATOL = before
    reached = np.sign(plain["Td"]) * min(abs(plain["Td"]), plain["Fmax"])
    return float(np.mean(((tau_env - plain["Td"]) / reached) ** 2))
