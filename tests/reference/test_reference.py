"""The two reference simulators against closed forms, and against each other as dt falls."""

from math import atan, cos, exp, inf, pi, sin, sqrt

import numpy as np
import pytest
from scipy.integrate import quad  # type: ignore[import-untyped,unused-ignore]

from . import discrete, events
from .laws import Choices, Params, energy, force
from .sensitivity import regular_scenarios, scale

PAPER = {"K0": 100.0, "Fmax": 15.0, "x0": 0.10, "xb": 0.11, "S": 20.0, "Td": 5.0, "xd": 0.0}
PAPER |= {"sigma": 0.01, "period": 0.01, "I": 10.0, "Kenv": 100.0, "Denv": 189.7, "gap": 0.0}
PAPER |= {"x_init": 0.0, "v_init": 0.0}
PRINTED = {"law": "algorithm1", "divergence": "velocity", "peak": "latched"}
PRINTED |= {"feedback": "interaction", "contact": "hard_stop", "expectation": "displacement"}
ALONE = {"period": 10.0, "gap": 5.0}
"""One tick, at t = 0, and an environment out of reach."""
FEEBLE = {"Fmax": 1e-12, "period": 10.0}
"""A motor without strength: the plant is left to itself."""
TIMES = np.linspace(0.05, 1.0, 20)
EXACT = 1e-8
"""What rtol = 1e-10 of the integrator leaves over some hundred steps."""


def run(changes: Params, **choices: str) -> dict[str, np.ndarray]:
    """The event-driven solution of a changed paper scenario at TIMES."""
    return events.simulate(PAPER | changes, PRINTED | choices, 1.0, TIMES)


@pytest.mark.parametrize("e", [0.03, -0.1, 0.1003, -0.105, 0.11, 0.3])
@pytest.mark.parametrize("S", [5.0, 20.0])
def test_energy_is_the_integral_of_force(e: float, S: float) -> None:
    p = PAPER | {"S": S}
    integral, _ = quad(force, 0.0, e, args=(p,), points=[0.1, -0.1, 0.11, -0.11], epsabs=1e-13)
    assert energy(e, p) == pytest.approx(integral, abs=1e-11)


def test_coasting() -> None:
    s = run(FEEBLE | {"gap": 5.0, "x_init": -0.3, "v_init": 0.7})
    assert s["x"] == pytest.approx(-0.3 + 0.7 * TIMES, abs=EXACT)


def test_saturated_divergence_is_uniform_acceleration() -> None:
    s = run(ALONE | {"x_init": -0.4, "v_init": -3.0})
    assert s["v"] == pytest.approx(-3.0 + 1.5 * TIMES, abs=EXACT)
    assert s["x"] == pytest.approx(-0.4 - 3.0 * TIMES + 0.75 * TIMES**2, abs=EXACT)


@pytest.mark.parametrize("law", ["algorithm1", "effort", "energy"])
def test_swing_from_rest_is_half_a_cosine(law: str) -> None:
    # A spring of 2 K0 about e_M / 2 with e_M = Td / K0 = 0.05 rad, which is within x0.
    s = run(ALONE | {"I": 20.0}, law=law)
    omega = sqrt(2.0 * 100.0 / 20.0)
    late = pi / omega > TIMES
    assert s["e"][late] == pytest.approx(0.025 * (1.0 + np.cos(omega * TIMES[late])), abs=EXACT)
    # It arrives with v = 0 at e = 0, where nothing pushes any more.
    assert np.all(np.abs(s["e"][~late]) < EXACT) and np.all(np.abs(s["v"][~late]) < EXACT)


def test_welded_springs_in_parallel_until_the_turn() -> None:
    # I ẍ = K0 (x_h - x) - Kenv x without damper, x_h = 0.05 rad, moving away from it at first.
    p = {"v_init": -0.05, "period": 10.0, "Denv": 0.0, "I": 100.0}
    s = run(p, contact="welded")
    omega = sqrt(200.0 / 100.0)
    turn = atan(0.05 / (0.025 * omega)) / omega
    t = TIMES[turn > TIMES]
    swing = 0.025 * (1.0 - np.cos(omega * t)) - 0.05 / omega * np.sin(omega * t)
    assert s["x"][: len(t)] == pytest.approx(swing, abs=EXACT)
    assert s["switches"][0] == pytest.approx(turn, abs=EXACT)


@pytest.mark.parametrize("contact", ["hard_stop", "damped_rebound"])
def test_bounce(contact: str) -> None:
    # In from -0.01 rad at 0.5 rad/s on a spring of 1000 N·m/rad; damper 40 N·m·s/rad or none.
    Denv = 40.0 if contact == "damped_rebound" else 0.0
    p = FEEBLE | {"x_init": -0.01, "v_init": 0.5, "Kenv": 1000.0, "Denv": Denv}
    s = run(p, contact=contact)
    decay, omega = Denv / 20.0, sqrt(100.0 - (Denv / 20.0) ** 2)
    assert s["contact_made"] == pytest.approx([0.02], abs=EXACT)
    assert s["contact_lost"] == pytest.approx([0.02 + pi / omega], abs=EXACT)
    t = 0.1 - 0.02
    assert s["x"][1] == pytest.approx(0.5 / omega * exp(-decay * t) * sin(omega * t), abs=EXACT)
    assert s["v"][-1] == pytest.approx(-0.5 * exp(-decay * pi / omega), abs=EXACT)


def test_hard_stop_rebounds_undamped() -> None:
    # Way in damped (sine over exponential), way out a quarter of a cosine from the deepest point.
    p = FEEBLE | {"v_init": 0.5, "Kenv": 1000.0, "Denv": 40.0}
    s = run(p)
    omega = sqrt(100.0 - 4.0)
    turn = atan(omega / 2.0) / omega
    deepest = 0.5 / omega * exp(-2.0 * turn) * sin(omega * turn)
    assert s["contact_lost"] == pytest.approx([turn + pi / 20.0], abs=EXACT)
    assert s["v"][-1] == pytest.approx(-10.0 * deepest, abs=EXACT)
    t = TIMES[3] - turn
    assert s["x"][3] == pytest.approx(deepest * cos(10.0 * t), abs=EXACT)


def test_chatter_is_refused() -> None:
    # F_K rises steeply beyond x0, so 2 E / e_M < F_K: with `energy` both sides of v = 0 lead back.
    p = PAPER | {"K0": 10.0, "xd": 0.105 - 0.5, "Kenv": 100.0, "gap": -0.08, "period": 10.0}
    with pytest.raises(events.Irregular, match="sliding"):
        events.simulate(p, PRINTED | {"law": "energy", "contact": "welded"}, 1.0)


def test_convergence_time_is_interpolated() -> None:
    # Samples at 0, 1 .. 5 s: 0.8 of the way from 0.75 to 1 is at the edge, and from 1.25 too.
    assert discrete.settled_from(np.array([1.0, 0.75, 1.0, 1.0, 1.0, 1.0]), 1.0) == pytest.approx(
        1.8
    )
    assert discrete.settled_from(np.array([1.0, 1.25, 1.0, 1.0, 1.0, 1.0]), 1.0) == pytest.approx(
        1.8
    )
    assert discrete.settled_from(np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]), 1.0) == pytest.approx(
        0.95
    )
    assert discrete.settled_from(np.ones(6), 1.0) == 0.0


def test_a_stay_shorter_than_a_twentieth_is_no_convergence() -> None:
    relative = np.array([*np.zeros(20), 1.0])
    assert discrete.settled_from(relative, 1.0) == inf
    assert discrete.settled_from(np.array([*np.zeros(19), 1.0, 1.0]), 1.0) == pytest.approx(18.95)
    assert discrete.settled_from(np.zeros(3), 1.0) == inf


def gaps(p: Params, choices: Choices, dt: float, exact: dict[str, np.ndarray]) -> float:
    """Largest difference of x at the times of `exact`, over the range of the motion."""
    every = round(float(exact["t"][0]) / dt)
    x = discrete.simulate(p, choices, dt, round(1.0 / dt))["x"][every - 1 :: every]
    return float(np.max(np.abs(x - exact["x"]))) / scale(exact["x"])


def test_discretisation_tends_to_the_event_driven_solution() -> None:
    """First order in dt, as switches are only seen at steps.

    Measured on 300 regular scenarios at dt = 4, 1 and 0.25 ms: median 1e-3, 2e-4, 6e-5, ninth
    decile 1e-2, 2e-3, 6e-4. The limits leave a factor of about three for the draw; the single
    worst case is left out, as its constant depends on how close a decision was.
    """
    steps = [4e-3, 1e-3, 2.5e-4]
    errors = []
    for p, choices in regular_scenarios(54, seed=3, t_end=1.0, dt=steps[-1]):
        exact = events.simulate(p, choices, 1.0, np.arange(1, 51) * 0.02)
        errors.append([gaps(p, choices, dt, exact) for dt in steps])
    median, ninth = np.percentile(errors, [50, 90], axis=0)
    assert len(errors) > 40
    assert np.all(median < [3e-3, 6e-4, 2e-4])
    assert np.all(ninth < [4e-2, 8e-3, 2e-3])
    assert median[0] > 8.0 * median[2] and ninth[0] > 8.0 * ninth[2]
