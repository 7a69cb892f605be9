"""JAX's transforms change no result: jit, vmap, scan, grad; types, compilations, checks."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fic_jax
from fic_jax import CHOICES, Model, Params, ParamsError, control, evaluate, init, rollout
from fic_jax import step as public_step
from fic_jax.controller import converging_slopes
from fic_jax.engine.xla import LANES
from fic_jax.params import canonical
from fic_jax.profile import energy, force
from tests.engine.scenarios import DT, pick, random_batch

TRACED = []  # names of the functions that JAX has traced since this module was imported
COMPILED = []


def record(event, seconds, fun_name="", **details):
    if event == "/jax/core/compile/jaxpr_trace_duration":
        TRACED.append(fun_name)
    if event == "/jax/core/compile/backend_compile_duration":
        COMPILED.append("rollout" if "rollout" in fun_name else fun_name)


jax.monitoring.register_event_duration_secs_listener(record)
APPROACH = Params(K0=100.0, Kenv=500.0, Td=5.0, gap=0.5, xd=0.5)


@pytest.mark.parametrize("law", CHOICES["law"])
def test_jit_equals_eager(law):
    """To a few ulp over 20 steps: compiled code may fuse a product and a sum."""
    model, states = Model(law=law), []
    for compiled in (True, False):
        state = init(APPROACH, model)
        with jax.disable_jit(not compiled):
            for _ in range(20):
                state, sample = public_step(APPROACH, state, model=model, dt=DT)
        states.append(jax.tree.map(np.asarray, (state, sample)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), *states)


def test_other_values_trace_nothing():
    """A second call with other values, types of number, N or dt traces nothing."""
    model = Model(law="effort")
    fic_jax.sweep(random_batch(10), model=model, dt=DT, n_steps=50)
    numbers = (3, 3.0, np.float64(3.0), np.array(4.0), jnp.float64(5.0))
    state = init(APPROACH, model)
    state, _ = public_step(APPROACH, state, model=model, dt=DT)
    evaluate(APPROACH, model=model, dt=DT, n_steps=50)
    traced = len(TRACED)
    assert traced
    for n in (1, 10, 3 * LANES):
        fic_jax.sweep(random_batch(n, seed=n), model=model, dt=DT / 2, n_steps=50)
    for K0 in numbers:
        evaluate(Params(K0=K0, Td=1), model=model, dt=np.float64(0.002), n_steps=50)
        state, _ = public_step(Params(K0=K0, gap=0.2), state, model=model, dt=0.002)
    assert TRACED[traced:] == []


def test_a_changed_model_or_step_count_compiles_once():
    new, counts = Model(peak="running", contact="damped_rebound"), []
    for n_steps in (7, 8, 7, 8):
        before = COMPILED.count("rollout")
        rollout(APPROACH, model=new, dt=DT, n_steps=n_steps)
        counts.append(COMPILED.count("rollout") - before)
    assert counts == [1, 1, 0, 0]


def test_float32_sums_are_accurate_over_long_runs():
    """Over 100,000 samples plain float32 sums err by 1e-3; compensated sums by rounding, 1e-7."""
    p, run = Params(Td=20.0), {"model": Model(contact="welded"), "dt": DT, "n_steps": 100_000}
    single = evaluate(jax.tree.map(np.float32, p), **run)
    double = evaluate(p, **run)
    for name in ("nmse", "nmse_tail", "steady_error"):
        assert float(getattr(single, name)) == pytest.approx(float(getattr(double, name)), rel=1e-5)


@pytest.mark.parametrize("function", [evaluate, rollout])
def test_concrete_values_are_checked_and_tracers_pass(function):
    with pytest.raises(ParamsError, match="`period` must be a whole multiple of dt"):
        function(Params(period=0.013), dt=DT, n_steps=5)
    with pytest.raises(ParamsError, match="`n_steps` must be a whole number, at least 1, but is 0"):
        function(Params(), dt=DT, n_steps=0)
    jax.jit(lambda period: function(Params(period=period), dt=DT, n_steps=5))(0.013)


def test_vmap_scan_and_user_jit_compose():
    batch = random_batch(5)

    @jax.jit
    def mine(batch):
        def one(p):
            def body(state, _):
                return public_step(p, state, dt=DT)

            return jax.lax.scan(body, init(p), length=30)[1].x

        columns = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), 5), batch)
        return jax.vmap(one)(columns)

    expected = [rollout(pick(batch, i), dt=DT, n_steps=30).x for i in range(5)]
    np.testing.assert_allclose(mine(batch), expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("contact", CHOICES["contact"])
@pytest.mark.parametrize("law", CHOICES["law"])
def test_gradients_are_finite_across_every_switch(law, contact):
    """Through an approach with contact, v = 0 and both branches; and starting exactly on them."""
    model = Model(law=law, contact=contact)
    starts = [
        APPROACH,
        Params(),  # at rest on the surface: e v = 0, x = gap
        Params(x_init=0.0, xd=0.05, Td=5.0),  # |e| = x0 at once
        Params(xd=0.06, Td=5.0),  # |e| = xb
        Params(xd=-0.05, Td=5.0),  # e = 0
    ]
    for p in starts:
        gradient = jax.grad(lambda p: evaluate(p, model=model, dt=DT, n_steps=150).nmse)(p)
        for name, value in vars(gradient).items():
            assert np.isfinite(value), (name, p)


def test_profile_gradients_are_finite_at_the_edges():
    p = Params()
    for e in (0.0, 0.1, -0.1, 0.11, -0.11, 1e30):
        for f in (force, energy):
            gradient = jax.grad(lambda e, p, f=f: f(e, p), argnums=(0, 1))(e, p)
            assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("name", ["K0", "I", "Kenv", "Denv", "Fmax", "sigma", "Td"])
def test_forward_and_reverse_derivatives_equal_central_differences(name):
    """Away from switches: welded, from rest, before the first v = 0."""

    def loss(value):
        p = Params(**{"Td": 6.0, "xd": 0.0, name: value})
        return evaluate(p, model=Model(contact="welded"), dt=DT, n_steps=40).nmse

    value = float(getattr(Params(), name))
    forward, reverse = jax.jvp(loss, (value,), (1.0,))[1], jax.grad(loss)(value)
    h = 1e-6 * max(value, 1e-2)
    central = (loss(value + h) - loss(value - h)) / (2 * h)
    # central differences of a smooth float64 function are good to about (1e-16/h)^(2/3)
    # atol for a derivative of zero: in the linear zone nmse does not depend on Td
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-9)


def test_dtype_follows_the_parameters():
    single = jax.tree.map(np.float32, APPROACH)
    assert evaluate(single, dt=DT, n_steps=5).nmse.dtype == np.float32
    assert evaluate(APPROACH, dt=DT, n_steps=5).nmse.dtype == np.float64
    assert fic_jax.sweep(random_batch(3, dtype=np.float32), dt=DT, n_steps=5).nmse.dtype == "f4"
    assert fic_jax.sweep(Params(K0=[100, 200]), dt=DT, n_steps=5).nmse.shape == (2,)


def test_control_decides_as_step_does():
    """On the same plant, `control` and `step` have the same x_h and e_M, bit for bit."""
    p, model = APPROACH, Model()
    state = init(p, model)
    memory, states = state.memory, []
    for _ in range(200):
        tau, memory = control(p, memory, state.x, state.v, state.measured, model=model, dt=DT)
        assert abs(float(tau)) <= p.Fmax
        state, sample = public_step(p, state, model=model, dt=DT)
        states.append((memory, state.memory))
        np.testing.assert_array_equal(memory.x_h, sample.x_h)
        np.testing.assert_array_equal(memory.e_M, sample.e_M)


@pytest.mark.parametrize("integrator", CHOICES["integrator"])
def test_a_changed_gain_acts_in_the_same_step(integrator):
    """Also in the slopes of the current branch: gains may be scheduled (claim C15)."""
    model = Model(contact="welded", integrator=integrator)
    p = Params(K0=100.0, Td=20.0, Fmax=60.0, xb=0.3, S=2.0)
    changed = replace(p, K0=60.0)
    state = init(p, model)
    for _ in range(500):
        state, sample = public_step(p, state, model=model, dt=DT)
        if not sample.diverging:
            break
    assert abs(sample.e_M) > 0.11
    _, after = public_step(changed, state, model=model, dt=DT)
    assert not after.diverging
    slopes = converging_slopes(after.e_M, canonical(changed), model)
    slope = slopes.inner if abs(after.e) <= changed.x0 else slopes.outer
    expected = np.clip(float(slope * (after.e - after.e_M / 2)), -p.Fmax, p.Fmax)
    assert float(after.torque) == pytest.approx(expected)
    assert abs(expected) < p.Fmax


def test_time_is_a_multiple_of_dt_and_not_a_sum():
    t = np.asarray(rollout(jax.tree.map(np.float32, APPROACH), dt=DT, n_steps=1000).t)
    np.testing.assert_array_equal(t, np.arange(1, 1001, dtype=np.float32) * np.float32(DT))


def test_model_refuses_an_unknown_choice():
    with pytest.raises(ParamsError, match="`law` must be one of algorithm1, effort, energy"):
        Model(law="algorithm2")
    assert hash(Model()) == hash(Model(law="algorithm1"))
