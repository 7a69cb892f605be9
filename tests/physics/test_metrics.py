"""Metrics of the motion against closed forms, and across the ways to compute them."""

import dataclasses

import jax
import numpy as np
import pytest

from fic_jax import CHOICES, METRICS, QUANTITIES, Model, Params, evaluate, sweep, trusted

LOCATED = Model(integrator="rk4_events")
# one tick at t = 0 within a run of less than 5 s, a motor without strength, and x_h = 0
FREE = {"period": 5.0, "Fmax": 1e-9, "K0": 1e-9, "Td": 1.0, "xd": -1e9}


def fields(**values):
    return Params(**FREE | values)


@pytest.mark.parametrize("dt", [0.01, 0.0025])
def test_free_flight_into_a_spring(dt):
    """From -0.1 rad at 0.5 rad/s on a spring of 1,000 N*m/rad, without damper: half a sine.

    T = A sin(w (t - 0.2 s)) in contact. With T_n = 1e-9 N*m the mean of eps^2 is that of
    (T - 1)^2 over 1e-18.
    """
    p = fields(x_init=-0.1, v_init=0.5, Kenv=1000.0, Denv=0.0)
    w, touch, end = 10.0, 0.2, 2.0
    half, A = np.pi / w, 1000.0 * 0.5 / w
    with jax.enable_x64(True):
        m = evaluate(p, model=LOCATED, dt=dt, n_steps=round(end / dt))
    # the integral of (A sin - 1)^2 over the contact, and of 1 outside of it
    squares = A**2 * half / 2.0 - 4.0 * A / w + half + (end - half)
    # 1e-7: a series of order five at 31 steps a contact
    assert float(m.nmse) * 1e-18 == pytest.approx(squares / end, rel=1e-7)
    assert float(m.peak_torque) == pytest.approx(A, rel=1e-7)
    assert float(m.contact_time) == pytest.approx(touch, abs=1e-12)
    assert float(m.contact_lost) == pytest.approx(end - touch - half, abs=1e-9)
    assert not np.isfinite(m.convergence_time)


def test_undamped_oscillation():
    """Welded at 0.02 rad, on a spring of 250 N*m/rad: T = 5 cos(w t) N*m, w = 5/s."""
    p = fields(x_init=0.02, Kenv=250.0, Denv=0.0)
    model = dataclasses.replace(LOCATED, contact="welded")
    end, w = 4.0, 5.0
    with jax.enable_x64(True):
        m = evaluate(p, model=model, dt=0.01, n_steps=400)

    def integral(t):
        """Of (5 cos(w t) - 1)^2."""
        return 12.5 * (t + np.sin(2 * w * t) / (2 * w)) - 10.0 * np.sin(w * t) / w + t

    assert float(m.nmse) * 1e-18 == pytest.approx(integral(end) / end, rel=1e-7)
    tail = (integral(end) - integral(end / 2)) / (end / 2)
    assert float(m.nmse_tail) * 1e-18 == pytest.approx(tail, rel=1e-7)
    mean = (5.0 * (np.sin(w * end) - np.sin(w * end / 2)) / w - end / 2) / (end / 2)
    assert float(m.steady_error) * 1e-9 == pytest.approx(mean, rel=1e-7)
    assert float(m.peak_torque) == pytest.approx(5.0, rel=1e-7)


@pytest.mark.parametrize("model", [Model(), LOCATED], ids=lambda m: m.integrator)
def test_constant_torque(model):
    """Pressed at rest with T = Td from the start: all errors are 0, converged at once."""
    p = Params(K0=100.0, Td=5.0, xd=0.05, gap=0.0, x_init=0.05, Kenv=100.0, sigma=0.0)
    with jax.enable_x64(True):
        m = evaluate(p, model=model, dt=0.01, n_steps=100)
    assert float(m.nmse) < 1e-25 and float(m.convergence_time) == 0.0
    assert float(m.contact_time) == 0.0 and float(m.contact_lost) == 0.0
    assert float(m.peak_torque) == pytest.approx(5.0)


def test_a_cycle_whose_last_sample_is_inside_has_not_converged():
    """T = 5 cos(5 t) N*m is within 5 % of T_n = 4.9 N*m for 0.1 s a turn, and at the end too."""
    p = fields(x_init=0.02, Kenv=250.0, Denv=0.0, Td=4.9, Fmax=4.9, xd=-4.9e9)
    model = dataclasses.replace(LOCATED, contact="welded")
    with jax.enable_x64(True):
        ends = [evaluate(p, model=model, dt=0.01, n_steps=n) for n in (250, 377)]  # 2 and 3 turns
    assert not any(np.isfinite(m.convergence_time) for m in ends)


@pytest.mark.parametrize(("integrator", "order"), [("rk4", 4.0), ("rk4_events", 5.0)])
def test_order_of_the_integrals_on_a_smooth_stretch(integrator, order):
    """A damped welded joint that the motor cannot move; its first step is not from rest."""
    p = fields(x_init=0.02, v_init=-0.3, Kenv=250.0, Denv=60.0)
    model = Model(contact="welded", integrator=integrator)
    with jax.enable_x64(True):
        *coarse, exact = (
            float(evaluate(p, model=model, dt=0.4 / n, n_steps=n).nmse) * 1e-18
            for n in (10, 20, 40, 1280)
        )
    errors = np.abs(np.array(coarse) - exact)
    assert np.all(np.log2(errors[:-1] / errors[1:]) > order - 0.1)


def scenarios(dtype, n=64):
    rng = np.random.default_rng(11)
    columns = {
        "K0": np.exp(rng.uniform(1.5, 5.5, n)),
        "Kenv": np.exp(rng.uniform(3.0, 6.9, n)),
        "Denv": rng.uniform(0.0, 300.0, n),
        "Td": rng.uniform(1.0, 12.0, n),
        "gap": rng.choice([0.0, 0.1], n),
        "I": rng.uniform(3.0, 20.0, n),
    }
    return Params(**{name: values.astype(dtype) for name, values in columns.items()})


@pytest.mark.parametrize("divergence", CHOICES["divergence"])
def test_lanes_xla_and_evaluate_agree(divergence):
    model = dataclasses.replace(LOCATED, divergence=divergence)
    batch = scenarios(np.float64, 16)
    with jax.enable_x64(True):
        one = jax.vmap(lambda p: evaluate(p, model=model, dt=0.01, n_steps=60), in_axes=(axes(),))
        results = [
            sweep(batch, model=model, dt=0.01, n_steps=60, backend=b) for b in ("lanes", "xla")
        ]
        results.append(one(batch))
    for name in METRICS:
        for other in results[1:]:
            np.testing.assert_allclose(
                getattr(results[0], name), getattr(other, name), rtol=1e-9, atol=1e-10
            )


def axes():
    varied = ("K0", "Kenv", "Denv", "Td", "gap", "I")
    return Params(**{name: 0 if name in varied else None for name in QUANTITIES})


def test_a_lane_alone_is_the_lane_among_others():
    """Lanes take as many iterations as they need, and are sorted by likeness."""
    batch = scenarios(np.float32, 200)
    together = sweep(batch, model=LOCATED, dt=0.01, n_steps=100, error_estimate=True)
    for i in (0, 17, 199):
        single = jax.tree.map(lambda a: a[i : i + 1] if np.ndim(a) else a, batch)  # noqa: B023
        alone = sweep(single, model=LOCATED, dt=0.01, n_steps=100, error_estimate=True)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_array_equal(a[i : i + 1], b)


def test_a_coin_is_not_trusted():
    """A chaotic limit cycle: with K0 = 0.1 and Td = 1 on a hard stop at 10 ms it never settles."""
    p = Params(K0=np.array([0.1]), Td=1.0, Kenv=100.0, Denv=189.7)
    with jax.enable_x64(True):
        found, errors = sweep(p, model=LOCATED, dt=0.01, n_steps=1000, error_estimate=True)
    flags = trusted(found, errors, 10.0)
    assert not flags.nmse_tail[0] and not flags.energy_in[0]
