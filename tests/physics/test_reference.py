"""Against the independent simulators of tests/reference: plain Python, and scipy with events."""

import itertools
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax import METRICS, Model, Params, rollout
from tests.reference import discrete, events
from tests.reference.scenarios import random_scenarios
from tests.reference.sensitivity import scale, sensitivity
from tests.streamed import streamed

DT, T_END = 1e-3, 1.0
N_STEPS = round(T_END / DT)
CHANNELS = ("x", "v", "x_h", "e", "e_M", "torque", "tau_env", "work")
SCENARIOS = random_scenarios(648, seed=20201)  # 6 for each of the 108 combinations of readings
GROUPS = 12
in_groups = pytest.mark.parametrize("group", range(GROUPS))


@partial(jax.jit, static_argnames=("model", "n_steps"))
def simulate(batch, dt, model, n_steps=N_STEPS):
    return jax.vmap(partial(rollout, model=model, dt=dt, n_steps=n_steps))(batch)


def metrics_of(batch, samples, contact):
    """Of the model the metrics know the contact only: 3 programs."""
    one = partial(streamed, dt=jnp.float64(DT), model=Model(contact=contact))
    return jax.vmap(one)(batch, samples)


def batch_of(params):
    return Params(**{name: jnp.array([p[name] for p in params]) for name in params[0]})


@cache
def simulated(group):
    """(p, choices, samples, metrics) of the scenarios of a group, compiled model by model."""

    def model_of(scenario):
        return tuple(sorted(scenario[1].items()))

    done = []
    for choices, some in itertools.groupby(
        sorted(SCENARIOS[group::GROUPS], key=model_of), key=model_of
    ):
        params = [p for p, _ in some]
        batch, model = batch_of(params), Model(**dict(choices))
        samples = simulate(batch, DT, model)
        out = samples, metrics_of(batch, samples, model.contact)
        for i, p in enumerate(params):
            samples, metrics = jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i]), out)
            done.append((p, dict(choices), samples, metrics))
    return done


@in_groups
def test_every_step_and_metric_equals_plain_python(group):
    """1e-9 of each channel's range at every step, and the metrics made of them.

    Both compute in float64 and differ by rounding, some 1e-15 a step. Where v = 0 within rounding,
    rounding decides the branch: such a scenario is compared up to that step, and at most one of
    a group's 54 (2 %) may be such.
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
    assert irregular <= 1


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
    """A step 8 times shorter, 4 to 0.5 ms, has 1/8 of the median error, within a factor of two."""
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
    ratio = np.median(errors[4e-3]) / np.median(errors[5e-4])
    assert 4.0 < ratio < 16.0
