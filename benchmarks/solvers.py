"""nmse of one scenario by other solvers: diffrax with constant and adaptive steps, Taylor series.

Each is written as a user of that library would simulate a controller with a period of 10 ms:
Algorithm 2 acts between two solves, and a solve holds its reference. The integral of (T - Td)^2 is
one more state of the solve.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import optimistix

from benchmarks.scenarios import N_PERIODS, PERIOD
from fic_jax import QUANTITIES, Model, Params, init
from fic_jax.controller import peak_error_after, torque
from fic_jax.environment import interaction_torque
from fic_jax.exploration import explore
from fic_jax.metrics import reachable
from fic_jax.piece import Piece, enter, law_at
from fic_jax.simulation import decide
from tests.reference import motion

Scenario = Callable[[Params], jax.Array]
MOST_STEPS = 4096  # of the solver in one period
MOST_PIECES = 20  # of smooth motion in one period


def constant_steps(model: Model, substeps: int) -> Scenario:
    """Tsit5 with `substeps` steps per period; Algorithm 1 sets branch and e_M before each step."""
    solver, term = diffrax.Tsit5(), diffrax.ODETerm(_held)
    h = jnp.asarray(PERIOD / substeps)

    def one(p: Params) -> jax.Array:
        def step(state: Any, _: None) -> tuple[Any, None]:
            x, v, square, measured, memory = state
            memory, attractor = decide(p, memory, x, v, measured, model, h)
            args = (p, memory.x_h, attractor, model)
            t, y = jnp.zeros_like(h), (x, v, square)
            start = solver.init(term, t, h, y, args)
            x, v, square = solver.step(term, t, h, y, args, start, made_jump=False)[0]
            return (x, v, square, interaction_torque(x, v, p, model), memory), None

        s = init(p, model)
        start = (s.x, s.v, jnp.zeros_like(s.x), s.measured, s.memory)
        state, _ = jax.lax.scan(step, start, length=N_PERIODS * substeps)
        return _nmse(p, state[2])

    return one


def _held(t: Any, y: Any, args: Any) -> Any:
    """x', v' and (T - Td)^2 with constant branch and e_M."""
    p, x_h, attractor, model = args
    x, v, _ = y
    tau_env = interaction_torque(x, v, p, model)
    return v, (torque(x_h - x, attractor, p) - tau_env) / p.I, (tau_env - p.Td) ** 2


def _nmse(p: Params, square: jax.Array) -> jax.Array:
    """From the integral of (T - Td)^2 over the run."""
    return square / (N_PERIODS * PERIOD) / reachable(p) ** 2


def adaptive_with_events(model: Model, rtol: float) -> Scenario:
    """Tsit5 with a PI step-size controller, tolerance `rtol`, for `divergence = "velocity"`.

    A solve ends at the next control period or at a switch, which is an Event: its law is smooth
    beyond the switch too. Without events, the branch would follow from the state, with e_M as one
    more: the motion would slide along v = 0, where Algorithm 1 sets a new e_M, and the steps would
    become tiny. With the flags of `tune_for_throughput`, XLA ends the process on this program
    (jaxlib 0.10.2).
    """
    solver, term = diffrax.Tsit5(), diffrax.ODETerm(_along)
    controller = diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol, pcoeff=0.3, icoeff=0.4)
    # In a step with both, the switch comes first: the motion is still beyond it after its stop.
    event = diffrax.Event(
        (_to_switch, _to_stop),
        optimistix.Newton(rtol=1e-3 * rtol, atol=1e-6 * rtol),
        direction=(False, False),
    )

    def one(p: Params) -> jax.Array:
        def piece(carry: Any) -> Any:
            t, x, v, e_M, square, x_h, count = carry
            a = enter(p, x, v, x_h, e_M, None, model)
            to = _next_switch(a)
            solution = diffrax.diffeqsolve(
                term,
                solver,
                t0=t,
                t1=PERIOD,
                dt0=PERIOD - t,
                y0=(jnp.zeros_like(x), a.u, square),
                args=(p, a, to),
                stepsize_controller=controller,
                max_steps=MOST_STEPS,
                throw=False,
                event=event,
            )
            passes, stops = solution.event_mask
            z, u, square = (leaf[0] for leaf in solution.ys)
            x = a.x + a.s * jnp.where(passes, to, z)
            x = jnp.where(passes & (to == a.wall), p.gap, x)
            v = jnp.where(stops, 0.0, a.s * u)
            e_M = peak_error_after(a.attractor, x_h - x)
            return solution.ts[0], x, v, e_M, square, x_h, count + 1

        def goes_on(carry: Any) -> jax.Array:
            return (carry[0] < PERIOD) & (carry[-1] < MOST_PIECES)

        def period(carry: Any, _: None) -> tuple[Any, None]:
            x, v, e_M, square, x_h = carry
            none = jnp.zeros_like(x, jnp.int32)
            tau_env = interaction_torque(x, v, p, model)
            x_h = explore(x_h, none, x, tau_env, p, model, PERIOD)[0]
            first = (jnp.zeros_like(x), x, v, e_M, square, x_h, none)
            return jax.lax.while_loop(goes_on, piece, first)[1:6], None

        s = init(p, model)
        first = (s.x, s.v, s.memory.e_M, jnp.zeros_like(s.x), s.memory.x_h)
        end, _ = jax.lax.scan(period, first, length=N_PERIODS)
        return _nmse(p, end[3])

    return one


def _next_switch(a: Piece) -> jax.Array:
    """The way (rad) to the next switch of law, torque limit or contact."""
    falls = a.slope > 0.0
    limit = jnp.where(falls, a.slack / jnp.where(falls, a.slope, 1.0), jnp.inf)
    return jnp.minimum(jnp.minimum(a.ahead, limit), a.wall)


def _along(t: Any, y: Any, args: Any) -> Any:
    """z', u' and (T - Td)^2 along a piece, all of them in the direction of the motion."""
    p, a, _ = args
    z, u, _ = y
    tau, _, _ = law_at(p, a, z)
    tau_env = a.tau_env + a.Kenv * z + a.Denv * (u - a.u)
    return u, (tau - tau_env) / p.I, (tau_env - a.s * p.Td) ** 2


def _to_switch(t: Any, y: Any, args: Any, **_: Any) -> Any:
    return args[2] - y[0]


def _to_stop(t: Any, y: Any, args: Any, **_: Any) -> Any:
    return y[1]


def by_taylor_series(p: Params, model: Model) -> float:
    """Taylor series of order 20 between located switches, in plain Python (tests/reference).

    Raises Irregular if the scenario chatters.
    """
    choices: dict[str, str] = {
        "law": model.law,
        "divergence": model.divergence,
        "peak": model.peak,
        "feedback": model.feedback,
        "contact": model.contact,
    }
    plain = {name: float(getattr(p, name)) for name in QUANTITIES}
    return motion.metrics(plain, choices, N_PERIODS * PERIOD)["nmse"]
