"""The exact metrics: against closed forms, against scipy, and as the limit of the discrete ones."""

from math import cos, exp, inf, log, pi, sin, sqrt

import numpy as np
import pytest

from . import discrete, events, motion
from .cells import Cell, State
from .laws import Choices, Params
from .scenarios import random_scenarios
from .sensitivity import conditions, distance, regular_metrics, regular_scenarios
from .taylor import Polynomial
from .test_reference import ALONE, PAPER, PRINTED

IDLE = {"K0": 1e-9, "xd": -5e9, "x0": 100.0, "xb": 101.0, "period": 10.0}
"""A controller so soft that it does nothing, though T_n = Td = 5 N·m: x_h = 0 and |e_M| < x0."""
EXACT = 1e-9
"""What the soft controller and rounding of x_h = xd + Td/K0 leave, relative."""
Td = PAPER["Td"]


def measure(changes: Params, t_end: float, **choices: str) -> dict[str, float]:
    """The metrics of a changed paper scenario; the tail is the second half."""
    return motion.metrics(PAPER | changes, PRINTED | choices, t_end)


def test_flight_into_a_wall() -> None:
    # Free for 0.6 s, then half an undamped swing of 0.5 rad/s on 1000 N·m/rad, then free again.
    m = measure(IDLE | {"x_init": -0.3, "v_init": 0.5, "Kenv": 1000.0, "Denv": 0.0}, 1.2)
    omega, peak = 10.0, 1000.0 * 0.5 / 10.0
    swing = pi / omega
    square = peak**2 * swing / 2.0 - 4.0 * peak * Td / omega + Td**2 * swing
    free = Td**2 * (0.6 - swing)
    assert m["contact_time"] == pytest.approx(0.6, abs=EXACT)
    assert m["contact_lost"] == pytest.approx(0.6 - swing, abs=EXACT)
    assert m["nmse"] == pytest.approx((square + free + Td**2 * 0.6) / Td**2 / 1.2, rel=EXACT)
    assert m["nmse_tail"] == pytest.approx((square + free) / Td**2 / 0.6, rel=EXACT)
    assert m["steady_error"] == pytest.approx(2.0 * peak / omega / Td / 0.6 - 1.0, rel=EXACT)
    assert m["peak_torque"] == pytest.approx(peak, rel=EXACT)
    assert m["overshoot"] == pytest.approx(peak / Td - 1.0, rel=EXACT)
    assert m["convergence_time"] == inf


@pytest.mark.parametrize("contact", ["hard_stop", "damped_rebound"])
def test_torque_jumps_at_an_impact(contact: str) -> None:
    # A pure damper: v decays as exp(-t / 5 s) from 3 rad/s, T from 1.2 Td, beginning at 0.6 s.
    p = IDLE | {"x_init": -1.8, "v_init": 3.0, "Kenv": 0.0, "Denv": 2.0}
    m = measure(p, 1.6, contact=contact)
    assert m["contact_time"] == pytest.approx(0.6, abs=EXACT)
    assert m["peak_torque"] == pytest.approx(1.2 * Td, rel=EXACT)
    assert m["overshoot"] == pytest.approx(0.2, rel=EXACT)
    assert m["convergence_time"] == pytest.approx(0.6 + 5.0 * log(1.2 / 1.05), abs=1e-8)


def test_convergence_may_be_the_instant_of_an_impact() -> None:
    # As above from 1.04 Td: inside the band as soon as it touches.
    p = IDLE | {"x_init": -1.56, "v_init": 2.6, "Kenv": 0.0, "Denv": 2.0}
    assert measure(p, 1.0)["convergence_time"] == pytest.approx(0.6, abs=EXACT)
    # Too short a stay for a run of 0.62 s.
    assert measure(p, 0.62)["convergence_time"] == inf


def test_rebound_pulls() -> None:
    # Out through x = gap at -0.5 rad/s: at once at its largest torque, and then no contact.
    p = IDLE | {"v_init": -0.5, "Denv": 40.0}
    m = measure(p, 1.0, contact="damped_rebound")
    assert m["peak_torque"] == 20.0
    assert (m["contact_time"], m["contact_lost"]) == (0.0, 1.0)
    assert m["nmse"] == pytest.approx(1.0)
    assert measure(p, 1.0, contact="hard_stop")["peak_torque"] == 0.0


@pytest.mark.parametrize("Denv", [0.0, 30.0])
def test_welded_oscillation(Denv: float) -> None:
    # From rest at 0.2 rad: x = 0.2 exp(-c t) (cos w t + c/w sin w t).
    m = measure(IDLE | {"x_init": 0.2, "Kenv": 1000.0, "Denv": Denv}, 2.0, contact="welded")
    c, w = Denv / 20.0, sqrt(100.0 - (Denv / 20.0) ** 2)
    # T = Kenv x + Denv v = 200 N·m exp(-c t) (cos w t - g sin w t)
    g = (1000.0 * c / w - Denv * (w + c * c / w)) / -1000.0

    def first(t: float) -> float:
        """∫ exp(-c t) (cos w t - g sin w t) dt from 0 to t."""
        at = [exp(-c * u) * complex(cos(w * u), sin(w * u)) / complex(-c, w) for u in (0.0, t)]
        return (at[1] - at[0]).real - g * (at[1] - at[0]).imag

    def second(t: float) -> float:
        """∫ exp(-2 c t) (cos w t - g sin w t)² dt from 0 to t."""
        rate = complex(-2.0 * c, 2.0 * w)
        wave = [
            exp(-2.0 * c * u) * complex(cos(2 * w * u), sin(2 * w * u)) / rate for u in (0.0, t)
        ]
        plain = (1.0 - exp(-2.0 * c * t)) / (2.0 * c) if c else t
        turned = wave[1] - wave[0]
        return 0.5 * ((1 + g * g) * plain + (1 - g * g) * turned.real - 2 * g * turned.imag)

    size = 200.0 / Td
    square = [size**2 * second(t) - 2.0 * size * first(t) + t for t in (1.0, 2.0)]
    assert m["nmse"] == pytest.approx(square[1] / 2.0, rel=EXACT)
    assert m["nmse_tail"] == pytest.approx(square[1] - square[0], rel=EXACT)
    assert m["steady_error"] == pytest.approx(size * (first(2.0) - first(1.0)) - 1.0, rel=EXACT)
    assert m["peak_torque"] == pytest.approx(200.0, rel=EXACT)
    # The largest T with the sign of Td is the start, with or without damper.
    assert m["overshoot"] == pytest.approx(39.0, rel=EXACT)
    assert abs(m["energy_in"]) < 1e-8


def test_constant_torque() -> None:
    # Saturated away from x_h: x moves by -3 t + 0.75 t² rad under 15 N·m.
    m = measure(ALONE | {"x_init": -0.4, "v_init": -3.0}, 1.0)
    assert m["energy_in"] == pytest.approx(15.0 * -2.25, rel=EXACT)
    assert (m["nmse"], m["nmse_tail"], m["steady_error"]) == (1.0, 1.0, -1.0)
    assert (m["peak_torque"], m["overshoot"], m["mode_switches"]) == (0.0, 0.0, 0.0)
    assert (m["contact_time"], m["contact_lost"]) == (inf, 0.0)


@pytest.mark.parametrize("tail_from", [0.3, 0.5])
def test_the_tail_may_begin_anywhere(tail_from: float) -> None:
    p = PAPER | IDLE | {"x_init": 0.2, "Kenv": 1000.0, "Denv": 0.0}
    m = motion.metrics(p, PRINTED | {"contact": "welded"}, 1.0, tail_from)
    mean = 40.0 * (sin(10.0) - sin(10.0 * tail_from)) / 10.0 / (1.0 - tail_from)
    assert m["steady_error"] == pytest.approx(mean - 1.0, rel=EXACT)


@pytest.mark.parametrize("law", ["algorithm1", "effort", "energy"])
def test_a_swing_gets_half_of_the_energy_back_until_its_middle(law: str) -> None:
    # Slope 2 K0 about e_M / 2, e_M = 0.05 rad: K0 (e_M / 2)² = 0.0625 J at a quarter of the turn.
    quarter = 0.5 * pi / sqrt(2.0 * 100.0 / 20.0)
    m = measure(ALONE | {"I": 20.0}, quarter, law=law)
    assert m["energy_in"] == pytest.approx(0.0625, rel=EXACT)
    assert m["mode_switches"] == 0.0  # it diverges for an instant only


def test_the_whole_swing_ends_at_rest() -> None:
    p = ALONE | {"I": 20.0}
    assert abs(measure(p, 3.0)["energy_in"]) < 1e-12
    assert not regular_metrics(PAPER | p, PRINTED, 3.0)["mode_switches"]


@pytest.mark.parametrize(
    ("v_init", "divergence", "switches", "of_steps"),
    [
        (0.1, "velocity", 0.0, 0.0),  # starts towards x_h
        (0.1, "error_rate", 0.0, 1.0),  # the first step compares with 0: |e| grew
        (-0.1, "velocity", 1.0, 1.0),  # turns once
        (-0.1, "error_rate", 1.0, 1.0),
        (0.0, "velocity", 0.0, 1.0),  # at rest counts as diverging, for an instant
        (0.005, "velocity_band", 1.0, 1.0),  # too slow to converge at first
    ],
)
def test_only_lasting_branches_count(
    v_init: float, divergence: str, switches: float, of_steps: float
) -> None:
    # The discretisation spends a step in the branch of an instant.
    p = PAPER | ALONE | {"v_init": v_init, "x_init": -0.4}
    choices = PRINTED | {"divergence": divergence}
    meter = motion.measured(p, choices, 0.5)
    assert meter.result()["mode_switches"] == switches
    assert meter.switches == of_steps
    steps = discrete.simulate(p, choices, 1e-3, 500)
    assert discrete.metrics(steps, p, choices, 1e-3)["mode_switches"] == of_steps


def test_a_joint_at_rest_changes_no_branch() -> None:
    # On the hard stop, in balance at T = Td, where rounding decides on the sign of v.
    p = PAPER | {"x_init": 0.05, "xd": 0.05, "v_init": 1e-19}
    steps = discrete.simulate(p, PRINTED, 0.01, 100)
    steps["diverging"][::2] ^= True
    assert discrete.metrics(steps, p, PRINTED, 0.01)["mode_switches"] == 0.0
    fast = steps | {"x": 0.05 + 1e-12 * np.arange(1, 101)}
    assert discrete.metrics(fast, p, PRINTED, 0.01)["mode_switches"] > 90.0


def test_the_attractor_remembers_the_start() -> None:
    # Moving towards x_h from the start: a spring of 2 K0 about e_M / 2 with e_M = 0.09 rad. The
    # tick at 0 then moves x_h by 1 % of Td/K0, as |x| > |xd|: e starts at 0.0905 rad.
    p = ALONE | {"x_init": -0.04, "v_init": 0.1, "I": 20.0}
    t = 0.2
    s = events.simulate(PAPER | p, PRINTED, t)
    w = sqrt(10.0)
    moved = 0.0455 * cos(w * t) - 0.1 / w * sin(w * t)
    assert s["e"][-1] == pytest.approx(0.045 + moved, abs=1e-9)
    assert s["e_M"][-1] == pytest.approx(0.09)
    steps = discrete.simulate(PAPER | p, PRINTED, 1e-3, 200)
    assert steps["e"][-1] == pytest.approx(0.045 + moved, abs=1e-9)


@pytest.mark.parametrize(("x_init", "searches"), [(0.05, True), (0.15, False), (0.25, True)])
def test_expectation_error_searches_beyond_twice_xd(x_init: float, searches: bool) -> None:
    p = PAPER | {"xd": 0.1, "x_init": x_init, "gap": 5.0}
    start, found = 0.1 + 5.0 / 100.0, {}
    for expectation in ("displacement", "error"):
        choices = PRINTED | {"expectation": expectation}
        found[expectation] = discrete.simulate(p, choices, 0.01, 1)["x_h"][0] != start
        assert (events.simulate(p, choices, 0.01)["x_h"][0] != start) == found[expectation]
    assert found["displacement"] == (x_init > 0.1)
    assert found["error"] == (abs(0.1 - x_init) > 0.1) == (searches and x_init > 0.2)


def test_pushing_down_mirrors_pushing_up() -> None:
    p = {"Denv": 20.0, "x_init": 0.03, "v_init": 0.2, "xd": 0.01}
    mirrored = {"x_init": -0.03, "v_init": -0.2, "xd": -0.01, "Td": -5.0}
    up = measure(p, 5.0, contact="welded")
    assert measure(p | mirrored, 5.0, contact="welded") == pytest.approx(up, rel=1e-9)


class Trace(motion.Meter):
    """A meter that also keeps t, x and v where its polynomials begin."""

    def __init__(self, p: Params, choices: Choices, t_end: float) -> None:
        super().__init__(p, choices, t_end, 0.5 * t_end)
        self.rows: list[tuple[float, float, float]] = []

    def measure(self, s: State, cell: Cell, x: Polynomial, v: Polynomial, h: float) -> None:
        self.rows.append((s.t, s.x, s.v))
        super().measure(s, cell, x, v, h)


def test_polynomials_follow_scipy() -> None:
    """Position and speed in 36 random scenarios: median 1e-12, worst 1e-8 for rtol = 1e-10."""
    errors = []
    for p, choices in random_scenarios(36, seed=5):
        trace = Trace(p, choices, 1.0)
        try:
            events.run(p, choices, 1.0, trace, motion.cross)
            rows = np.array([row for row in trace.rows if row[0] > 0.0])
            s = events.simulate(p, choices, 1.0, rows[:, 0])
        except events.Irregular:
            continue
        errors.append(max(np.max(np.abs(s[name] - rows[:, i])) for i, name in ((1, "x"), (2, "v"))))
    assert len(errors) > 28
    assert np.median(errors) < 1e-11
    assert max(errors) < 1e-7


STEPS = (4e-3, 1e-3, 2.5e-4)


def test_discrete_metrics_tend_to_the_exact_ones() -> None:
    """Each metric where it is regular; distances as in sensitivity.py.

    Measured on 100 scenarios: the median falls by four from step to step, and the ninth decile of
    nmse is 2e-2, 3e-3, 5e-4. A switch that misses a tick within a step is a coin at this dt, so
    that single cases stay away: 97 of 100 count the same mode switches at the shortest step.
    """
    errors: dict[str, list[list[float]]] = {name: [] for name in motion.METRICS}
    for p, choices in regular_scenarios(54, seed=3, t_end=1.0, dt=STEPS[-1]):
        meter, condition = motion.measured(p, choices, 1.0), conditions(p, choices, 1.0)
        # Steps spend one in the branch of an instant, and their count tends to that with instants.
        exact = meter.result() | {"mode_switches": float(meter.switches)}
        runs = [
            discrete.metrics(discrete.simulate(p, choices, dt, round(1.0 / dt)), p, choices, dt)
            for dt in STEPS
        ]
        for name, found in errors.items():
            if condition[name] <= 100.0:
                found.append([distance(name, exact[name], run[name], 1.0) for run in runs])
    for name, found in errors.items():
        assert len(found) > 40, name
        median, ninth = np.percentile(found, [50, 90], axis=0, method="nearest")
        assert median[-1] <= 2e-4, name
        assert ninth[-1] <= 3e-2, name
        assert median[-1] <= median[0] / 8.0 and ninth[-1] <= ninth[0] / 4.0, name
    assert np.mean(np.array(errors["mode_switches"])[:, -1] == 0.0) > 0.9
