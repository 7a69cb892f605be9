"""Against the independent simulators of tests/reference: plain Python, and scipy with events."""

import itertools
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax import METRICS, Model, Params, evaluate, rollout, sweep
from tests.reference import discrete, events
from tests.reference.scenarios import random_scenarios
from tests.reference.sensitivity import scale, sensitivity
from tests.torture import many

DT, T_END = 1e-3, 1.0
N_STEPS = round(T_END / DT)
CHANNELS = ("x", "v", "x_h", "e", "e_M", "torque", "tau_env", "work")
# three for each of 24 readings, or of all 216; every reading is a program to compile
READINGS, EACH = many(24, 216), 3
SCENARIOS = [
    scenario
    for i, scenario in enumerate(random_scenarios(EACH * 216, seed=20201))
    if i % 216 < READINGS
]
GROUPS = many(2, 12)
in_groups = pytest.mark.parametrize("group", range(GROUPS))


@partial(jax.jit, static_argnames=("model", "n_steps"))
def simulate(batch, dt, model, n_steps=N_STEPS):
    return jax.vmap(partial(rollout, model=model, dt=dt, n_steps=n_steps))(batch)


def batch_of(params):
    return Params(**{name: jnp.array([p[name] for p in params]) for name in params[0]})


@cache
def simulated(group):
    """(p, choices, samples, metrics) of the scenarios of a group, compiled model by model."""

    def model_of(scenario):
        return tuple(sorted(scenario[1].items()))

    done = []
    ordered = sorted(SCENARIOS, key=model_of)
    size = len(ordered) // GROUPS
    ordered = ordered[group * size : (group + 1) * size]
    for choices, some in itertools.groupby(ordered, key=model_of):
        params = [p for p, _ in some]
        batch, model = batch_of(params), Model(**dict(choices))
        out = simulate(batch, DT, model), sweep(batch, model=model, dt=DT, n_steps=N_STEPS)
        for i, p in enumerate(params):
            samples, metrics = jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i]), out)
            done.append((p, dict(choices), samples, metrics))
    return done


@in_groups
def test_every_step_and_metric_equals_plain_python(group):
    """1e-9 of each channel's range at every step, and the metrics made of them.

    Both compute in float64 and differ by rounding, some 1e-15 a step. Where v = 0 within rounding,
    rounding decides the branch: such a scenario is compared up to that step, and at most one in
    twenty may be such. The metrics are those of another program, a sweep.
    """
    irregular = 0
    for p, choices, samples, metrics in simulated(group):
        plain = discrete.simulate(p, choices, DT, N_STEPS)
        same = samples.diverging == plain["diverging"]
        regular = bool(same.all())
        upto = N_STEPS if regular else int(np.argmin(same))
        irregular += not regular
        for name in CHANNELS:
            ours, theirs = getattr(samples, name)[:upto], plain[name][:upto]
            size = max(np.max(np.abs(theirs), initial=0.0), 1e-3)
            error = np.max(np.abs(ours - theirs), initial=0.0) / size
            assert error < 1e-9, (name, error, p, choices)
        if regular:
            expected = discrete.metrics(plain, p, choices, DT)
            for name in METRICS:
                assert getattr(metrics, name) == pytest.approx(expected[name], rel=1e-9, abs=1e-9)
    assert irregular <= len(simulated(group)) / 20


@in_groups
def test_rk4_follows_scipy_with_events(group):
    """The motion x(t) against scipy with switches and contacts located, in parts of its range.

    RK4 with the mode held in a step errs to first order at each switch: by about the way of one
    step, 1e-3 s * 1 rad/s on motions of 0.1 rad, that is 1 %, times the motion's sensitivity.
    Scenarios with an error above 1e-3 are excluded if their sensitivity exceeds 10, if they slide
    along a switch, or if one jump of x_h decides their branch; at most a third may be. A motion
    that grazes v = 0 within the error of a step starts a new e_M or does not: one in 25 of the
    others may differ for that reason.
    """
    errors, apart = [], 0
    seen = slice(19, None, 20)  # every 20 ms, the common grid of all periods
    for p, choices, samples, _ in simulated(group):
        try:
            exact = events.simulate(p, choices, T_END, samples.t[seen])
        except events.Irregular:
            apart += 1
            continue
        error = np.max(np.abs(samples.x[seen] - exact["x"])) / scale(exact["x"])
        on_edge = exact["margins"].min(initial=np.inf) <= 4.0 * DT
        if error > 1e-3 and (on_edge or sensitivity(p, choices, T_END) > 10.0):
            apart += 1
            continue
        errors.append(error)
    assert apart <= len(simulated(group)) // 3
    assert np.median(errors) < 1e-3
    assert np.percentile(errors, 90) < 1e-2
    assert np.sum(np.array(errors) > 5e-2) <= len(errors) / 25


def test_time_out_of_contact_is_counted_at_step_ends():
    """It flies past a wall that does nothing: one step of 10 ms in contact, 0.2 s out of it."""
    p = Params(K0=1e-9, xd=-5e9, x0=100.0, xb=101.0, period=1.0, Kenv=1e3, Denv=0.0)
    p = replace(p, x_init=-0.05, v_init=0.5, I=0.1)
    s, m = (f(p, dt=0.01, n_steps=60) for f in (rollout, evaluate))
    touch = np.asarray(s.x) >= 0.0
    first = int(np.argmax(touch))
    assert first > 0
    assert not touch[first:].all()
    assert float(m.contact_lost) == pytest.approx(0.01 * np.sum(~touch[first:]))


@pytest.mark.parametrize(
    "choices",
    [
        {},
        {"contact": "welded", "law": "effort"},
        {"contact": "damped_rebound", "divergence": "error_rate", "peak": "running"},
        {"law": "energy", "divergence": "velocity_band", "feedback": "motor"},
    ],
)
def test_rk4_converges_to_scipy_with_events_at_first_order(choices):
    """A step 8 times shorter, 4 to 0.5 ms, has a quarter of the error or less.

    That is the error at the 90th percentile: more than half may have no switch, and order four.
    """
    model = Model(**choices)
    chosen = {name: getattr(model, name) for name in ("law", "divergence", "peak", "feedback")}
    chosen["contact"] = model.contact
    params = [p for p, _ in random_scenarios(40, seed=5)]
    params = [p for p in params if sensitivity(p, chosen, T_END) < 10.0]
    assert len(params) > 24
    grid = 0.02 * np.arange(1, round(T_END / 0.02) + 1)
    exact = [events.simulate(p, chosen, T_END, grid)["x"] for p in params]
    errors = {}
    for dt in (4e-3, 5e-4):
        n_steps, stride = round(T_END / dt), round(0.02 / dt)
        x = np.asarray(simulate(batch_of(params), dt, model, n_steps).x)[:, stride - 1 :: stride]
        errors[dt] = [
            np.max(np.abs(ours - theirs)) / scale(theirs)
            for ours, theirs in zip(x, exact, strict=True)
        ]
    ratio = np.percentile(errors[4e-3], 90) / np.percentile(errors[5e-4], 90)
    assert ratio > 4.0
