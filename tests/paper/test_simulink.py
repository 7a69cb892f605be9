"""Runs as Simulink would make them: scipy's steps, a plain loop over ode4's stages, logs."""

import numpy as np
import pytest
from scipy.integrate import RK23

from fic_jax import Model, Params, sweep
from sweeps.paper import accepted, logs, simulink
from sweeps.paper.claims import impact
from sweeps.paper.scenarios import LOCATED, Reading, study, table
from tests.reference import laws
from tests.torture import many

HARD = Model(contact="hard_stop")
CASES = [Params(), Params(Kenv=50.0, gap=0.5, xd=0.5), Params(K0=1000.0)]


def batch(cases):
    return Params(*(np.array(leaf, float) for leaf in zip(*map(vars_of, cases), strict=True)))


def vars_of(p):
    return list(vars(p).values())


# --- solvers that choose their steps -------------------------------------------------------------


@pytest.fixture(scope="module")
def stepped():
    return simulink.logged(batch(CASES), HARD, "RK23", 0.01, 1e-3).runs()


@pytest.mark.parametrize("case", range(len(CASES)))
def test_rk23_takes_the_steps_of_scipy(stepped, case):
    """The same first step and tolerances: equal until rounding, which chooses steps, adds up."""
    theirs = accepted.accepted_steps(CASES[case], RK23, first=simulink.FIRST)
    ours = stepped[case]
    n = 40
    np.testing.assert_allclose(ours.t[:n], theirs["t"][:n], rtol=1e-7)
    np.testing.assert_allclose(ours.tau_env[:n], theirs["tau_env"][:n], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("clock", list(simulink.ATTEMPTS))
def test_a_smaller_tolerance_of_the_free_flight_lands_at_the_same_touch(clock):
    """Until the touch Algorithm 2 sets the same reference each time: an initial value problem."""
    p = batch([Params(gap=0.5, xd=0.5)])
    run = simulink.logged(p, HARD, clock, 0.01, 1e-8).runs()[0]
    touch = sweep(p, model=HARD.with_events(), dt=1e-3, n_steps=3000).contact_time[0]
    first = int(np.argmax(run.x >= 0.5))
    step = slice(first - 1, first + 1)
    # an absolute tolerance of 1e-6 a step, and a chord over the step at the touch
    assert np.interp(0.5, run.x[step], run.t[step]) == pytest.approx(touch, abs=1e-3)


def test_a_solver_reports_to_the_end_and_not_beyond(stepped):
    for run in stepped:
        assert run.t[0] == 0.0 and run.t[-1] == simulink.T_END
        assert np.all(np.diff(run.t) > 0.0) and np.diff(run.t).max() <= simulink.LIMIT + 1e-12


def test_padding_changes_no_run(stepped):
    alone = simulink.logged(batch(CASES[1:2]), HARD, "RK23", 0.01, 1e-3).runs()[0]
    np.testing.assert_array_equal(alone.tau_env, stepped[1].tau_env)


# --- ode4 ----------------------------------------------------------------------------------------


def by_hand(p, both, dt=0.01, n=1000):
    """T at each step of ode4 with Algorithm 2, or both, at each stage; plain Python."""
    p = {name: float(value) for name, value in vars(p).items()}
    x, v, F = p["x_init"], p["v_init"], 0.0
    x_h = laws.start_reference(p)
    e_M, found = x_h - x, []

    def rates(x, v, x_h, e_M, away):
        tau = laws.torque(x_h - x, e_M, away, p, "algorithm1")
        return v, (tau - laws.environment(x, v, p, "welded")) / p["I"]

    for _ in range(n):
        y, k = (x, v), []
        for i, part in enumerate((0.0, 0.5, 0.5, 1.0)):
            if i:
                y = (x + part * dt * k[-1][0], v + part * dt * k[-1][1])
                F = laws.environment(*y, p, "welded")
            x_h = laws.explore(y[0], x_h, F, p)
            if both or not i:
                away = laws.diverges(x_h - y[0], y[1], 0.0, "velocity")
                e_M = x_h - y[0] if away else e_M
            k.append(rates(*y, x_h, e_M, away))
        x += dt / 6.0 * (k[0][0] + 2.0 * k[1][0] + 2.0 * k[2][0] + k[3][0])
        v += dt / 6.0 * (k[0][1] + 2.0 * k[1][1] + 2.0 * k[2][1] + k[3][1])
        F = laws.environment(x, v, p, "welded")
        found.append(F)
    return np.array(found)


@pytest.mark.parametrize("clock", ["stages", "both at stages"])
def test_a_plain_loop_over_the_stages_gives_the_same_torque(clock):
    cases = [Params(), Params(K0=10.0), Params(K0=1000.0, Td=1.0)]
    runs = simulink.logged(batch(cases), Model(contact="welded"), clock, 0.01, 1e-3).runs()
    for p, run in zip(cases, runs, strict=True):
        expected = by_hand(p, clock == "both at stages")
        # rounding, which no turn of these joints amplifies
        np.testing.assert_allclose(run.tau_env[1:], expected, rtol=1e-9, atol=1e-9)


def test_the_search_at_the_stages_is_what_the_paper_prints_of_the_welded_study():
    """model.md: all twelve nmse at most 0.1, the worst at K0 = 1 and Td = 1; one tail is not."""
    table = study("welded", Reading(clock="stages")).query("K0 >= 1 and Td <= Fmax")
    assert len(table) == 12 and table["nmse_trusted"].all()
    worst = table.loc[table["nmse"].idxmax()]
    assert (worst["K0"], worst["Td"]) == (1.0, 1.0)
    # integrals: 5e-4 more than means over step ends, which leave the start out
    assert worst["nmse"] == pytest.approx(0.0818, abs=2e-4)
    stiff = table.query("K0 == 1000")
    assert stiff["nmse"].max() == pytest.approx(0.0692, abs=2e-4)
    assert stiff["nmse_tail"].max() == pytest.approx(0.0137, abs=1e-4)


# --- x~ as the error -----------------------------------------------------------------------------


def test_with_the_error_as_x_the_torque_stays_below_the_desired_one():
    """model.md: in 5 of 5 approaches, at or below Td Kenv/(K0 + Kenv)."""
    seen = impact.observed(Reading(Model(expectation="error").with_events()))
    assert (seen["highest"] < 0.0).all() and seen["highest_trusted"].all()


# --- logs ----------------------------------------------------------------------------------------


def log(t, T, x=None):
    t, T = np.array([t], float), np.array([T], float)
    x = np.ones_like(t) if x is None else np.array([x], float)
    return logs.Log(t, x, np.zeros_like(t), T, np.zeros_like(t))


def one(log, **changes):
    rows = table(Params(Td=2.0, **changes)).assign(contact="hard_stop")
    return logs.measured(log, rows).iloc[0]


def test_a_mean_of_samples_weighs_steps_and_a_mean_over_time_does_not():
    """eps = -1 for 5 s in one step, 0 for 5 s in four."""
    found = one(log([0, 5, 5 + 1e-9, 6, 7, 8, 10], [0, 0, 2, 2, 2, 2, 2]))
    assert found["nmse"] == pytest.approx(0.5)
    assert found["nmse_of_samples"] == pytest.approx(1 / 6)
    assert found["nmse_tail"] == pytest.approx(0.0, abs=1e-9)


def test_times_of_a_log():
    T = [0.0, 1.0, 3.0, 2.0, 2.0, 2.0, 2.0]
    x = [0.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    found = one(log([0, 1, 2, 3, 4, 6, 10], T, x), gap=0.5)
    assert (found["contact_time"], found["contact_lost"]) == (1.0, 1.0)
    assert found["convergence_time"] == pytest.approx(2.9)  # 3 -> 2 passes 2.1 there
    assert found["overshoot"] == pytest.approx(0.5) and found["peak_torque"] == 3.0


def test_a_torque_that_enters_its_band_at_the_end_has_not_converged():
    assert np.isinf(one(log([0, 9.7, 10], [0, 0, 2]))["convergence_time"])
    assert np.isinf(one(log([0, 5, 10], [0, 2, 0]))["convergence_time"])


def test_a_limit_cycle_of_a_solver_s_steps_is_not_trusted():
    """K0 = 1, Td = 5 pressed on the stop turns hundreds of times: its numbers hang on rounding."""
    seen = study("contact", Reading(clock="RK23")).set_index(["K0", "Td"])
    assert not seen.loc[(1.0, 5.0), "nmse_trusted"]
    assert seen.loc[(100.0, 5.0), "nmse_trusted"]


# --- located peaks -------------------------------------------------------------------------------


def test_the_peak_at_the_touch_is_the_metric_s():
    """Two ways to the same number: from the speed before the touch, and the streamed maximum."""
    seen = impact.observed(LOCATED).query("Denv > 0")
    np.testing.assert_allclose(seen["error"], seen["overshoot"], rtol=1e-5)


@pytest.mark.skipif(not many(0, 1), reason="`make torture`")
def test_what_histories_show_is_converged():
    """A tenth of the sample: the numbers of C7 and C8 move by less than their bounds."""
    coarse = impact.observed(LOCATED)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sweeps.paper.scenarios.SAMPLE", 1e-4)
        impact.observed.cache_clear()
        fine = impact.observed(LOCATED)
    np.testing.assert_array_equal(fine["turns"], coarse["turns"])
    for name in ("spike", "highest", "last", "error"):
        np.testing.assert_allclose(fine[name], coarse[name], rtol=0.01, atol=1e-4)
