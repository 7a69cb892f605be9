"""Laws that hold for every scenario, on random ones."""

from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fic_jax import CHOICES, Model, Params, energy, evaluate, force, rollout
from fic_jax.controller import begin_branch, diverges, torque

DT, N_STEPS = 0.01, 300


def numbers(low, high):
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


def log_numbers(low, high):
    return numbers(np.log(low), np.log(high)).map(lambda u: float(np.exp(u)))


@st.composite
def scenarios(draw):
    """Anything a user may sweep, K0 x0 > Fmax and the wall out of reach included."""
    x0 = draw(numbers(0.02, 0.2))
    return Params(
        K0=draw(log_numbers(0.1, 1000.0)),
        Fmax=draw(numbers(1.0, 40.0)),
        x0=x0,
        xb=x0 + draw(numbers(0.005, 0.1)),
        S=draw(numbers(1.0, 30.0)),
        Td=draw(numbers(0.5, 30.0)),
        xd=draw(st.sampled_from([0.0, 0.001, -0.05, 0.5])),
        sigma=draw(log_numbers(1e-4, 0.3)),
        period=DT * draw(st.integers(1, 30)),
        I=draw(log_numbers(0.5, 50.0)),
        Kenv=draw(log_numbers(1.0, 1000.0)),
        Denv=draw(numbers(0.0, 300.0)),
        gap=draw(st.sampled_from([0.0, 0.2, 0.5])),
        x_init=draw(numbers(-0.3, 0.3)),
        v_init=draw(numbers(-1.0, 1.0)),
    )


MODELS = [
    Model(),
    Model(law="effort", divergence="error_rate", peak="running", contact="damped_rebound"),
    Model(law="energy", divergence="velocity_band", feedback="motor", contact="welded"),
]
models = pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{m.law}-{m.contact}")
# derandomize: the seed is fixed, so a failure here is the same everywhere
law = settings(max_examples=150, deadline=None, derandomize=True)
roll = partial(rollout, dt=DT, n_steps=N_STEPS)


@law
@given(p=scenarios(), e=numbers(-2.0, 2.0))
def test_force_is_odd(p, e):
    assert float(force(e, p)) == -float(force(-e, p))


@pytest.mark.parametrize("name", CHOICES["law"])
@law
@given(p=scenarios(), e=numbers(-2.0, 2.0), e_M=numbers(-2.0, 2.0), v=numbers(-3.0, 3.0))
def test_torque_never_exceeds_the_saturation(name, p, e, e_M, v):
    model = Model(law=name)
    tau = torque(e, begin_branch(e, diverges(e, v, abs(e_M), model), e_M, p, model), p)
    assert abs(float(tau)) <= p.Fmax


@models
@law
@given(p=scenarios())
def test_rollouts_stay_within_the_saturation_and_are_finite(model, p):
    s = roll(p, model=model)
    assert not np.any(np.abs(s.torque) > p.Fmax)  # an unstable run ends in NaN
    if np.sqrt(p.Kenv / p.I) * DT < 1.0 and p.Denv / p.I * DT < 1.0:  # dt resolves the plant
        assert np.isfinite(s.x).all()


@law
@given(p=scenarios())
def test_hard_stop_never_pulls(p):
    s = roll(p, model=Model())
    assert np.min(s.tau_env) >= 0.0
    assert np.all(np.asarray(s.tau_env)[np.asarray(s.x) < p.gap] == 0.0)


@pytest.mark.parametrize("divergence", CHOICES["divergence"])
@pytest.mark.parametrize("peak", CHOICES["peak"])
@law
@given(p=scenarios())
def test_mirrored_scenario_gives_mirrored_motion(divergence, peak, p):
    """Welded: with all signed quantities negated, the signals are negated, bit for bit."""
    model = Model(contact="welded", divergence=divergence, peak=peak)
    signed = ("Td", "xd", "gap", "x_init", "v_init")
    mirrored = Params(**{k: -v if k in signed else v for k, v in vars(p).items()})
    one, other = roll(p, model=model), roll(mirrored, model=model)
    for name in ("x", "v", "x_h", "e", "e_M", "torque", "tau_env"):
        np.testing.assert_array_equal(getattr(one, name), -getattr(other, name))
    np.testing.assert_array_equal(one.diverging, other.diverging)
    np.testing.assert_array_equal(one.work, other.work)


@pytest.mark.parametrize("integrator", CHOICES["integrator"])
@models
@law
@given(p=scenarios())
def test_metrics_are_consistent(model, integrator, p):
    """What holds for any motion, whatever its samples are."""
    m = evaluate(p, model=replace(model, integrator=integrator), dt=DT, n_steps=N_STEPS)
    if not m.finite:
        return
    t_end, tail, slack = N_STEPS * DT, 1 - N_STEPS // 2 / N_STEPS, 1 + 1e-12
    T_n = min(p.Td, p.Fmax)
    assert m.nmse >= 0.0
    assert m.nmse_tail * tail <= m.nmse * slack  # the tail is part of the whole
    assert m.steady_error**2 <= m.nmse_tail * slack + 1e-20  # the mean's square and the mean square
    assert (1.0 + m.overshoot) * T_n <= max(float(m.peak_torque), T_n) * slack
    assert m.contact_lost == 0.0 or m.contact_time + m.contact_lost <= t_end * slack
    assert m.contact_time == np.inf or 0.0 <= m.contact_time <= t_end * slack
    assert m.convergence_time == np.inf or 0.0 <= m.convergence_time <= 0.95 * t_end * slack
    if model.contact == "hard_stop":
        assert m.steady_error >= -p.Td / T_n * slack  # it does not pull
    if m.contact_time == np.inf:
        assert float(m.nmse) == pytest.approx((p.Td / T_n) ** 2)
        assert m.peak_torque == m.contact_lost == 0.0


@law
@given(p=scenarios())
def test_the_law_energy_releases_no_more_than_its_spring_has_stored(p):
    """Attractor alone, fixed reference: the kinetic energy stays below the initial total energy.

    `energy` (the older law) is passive: it releases the energy that divergence stored, E_K(e_M)
    (eq. 2). The branch is decided once a step, which adds the torque's work in one step.
    """
    free = Params(**{**vars(p), "sigma": 0.0, "gap": 100.0, "Kenv": 0.0, "Denv": 0.0, "xd": 0.0})
    s = roll(free, model=Model(law="energy"))
    x_h = free.Td / free.K0
    kinetic = 0.5 * p.I * np.asarray(s.v) ** 2
    start = 0.5 * p.I * p.v_init**2 + float(energy(jnp.float64(x_h - p.x_init), free))
    top = np.max(np.abs(s.v)) + p.Fmax / p.I * DT
    slack = 4.0 * p.Fmax * top * DT * (1 + int(np.sum(s.diverging[1:] != s.diverging[:-1])))
    assert np.max(kinetic) <= start + slack
