"""Exact solutions of the plant and of the attractor. First in authority."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax import Model, Params, energy, force, rollout
from fic_jax.controller import begin_branch, departs, torque

TRUE = np.bool_(True)

NO_TORQUE = {"K0": 1e-12, "Fmax": 1e-12, "Td": 1e-12}


def test_free_flight():
    """Without torque and before the wall, x = x_init + v_init t."""
    p = Params(**NO_TORQUE, gap=10.0, x_init=-0.3, v_init=0.7)
    s = rollout(p, dt=0.01, n_steps=500)
    np.testing.assert_allclose(s.x, -0.3 + 0.7 * s.t, atol=1e-11)  # 1e-12 N*m over 5 s
    np.testing.assert_array_equal(s.tau_env, 0.0)


def test_undamped_oscillation_on_the_welded_spring_with_order_four():
    """x = A cos(w t), w = sqrt(Kenv/I); halving dt divides the error by 2^4 within 0.1 in order."""
    p = Params(**NO_TORQUE, Kenv=250.0, Denv=0.0, I=10.0, x_init=0.2, period=0.02)
    errors = []
    for n in (200, 400):
        s = rollout(p, model=Model(contact="welded"), dt=4.0 / n, n_steps=n)
        errors.append(np.max(np.abs(s.x - 0.2 * np.cos(5.0 * s.t))))
    assert errors[0] < 1e-4
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.1)


def test_damped_oscillation_on_the_welded_spring():
    """Underdamped free response, zeta = 0.2."""
    w, zeta, inertia = 4.0, 0.2, 5.0
    p = Params(**NO_TORQUE, I=inertia, Kenv=inertia * w**2, Denv=2 * zeta * w * inertia, x_init=0.1)
    s = rollout(p, model=Model(contact="welded"), dt=1e-3, n_steps=4000)
    wd = w * np.sqrt(1 - zeta**2)
    decay = np.exp(-zeta * w * s.t)
    exact = 0.1 * decay * (np.cos(wd * s.t) + zeta * w / wd * np.sin(wd * s.t))
    np.testing.assert_allclose(s.x, exact, atol=1e-11)  # (w dt)^4 = 3e-10, times some 1e-2 rad


@pytest.mark.parametrize(
    ("law", "e0", "slope"),
    [
        ("algorithm1", 0.09, 2 * 100.0),  # linear zone: both slopes are 2 K0
        ("effort", 0.3, 2 * 15.0 / 0.3),  # 2 F_K(e_M)/e_M with F_K = Fmax
        ("effort", 0.6, 2 * 15.0 / 0.6),
    ],
)
def test_release_of_the_bare_attractor(law, e0, slope):
    """Released at rest, e = e0 (1 + cos w t)/2 with w = sqrt(slope/I): it arrives at x_h at rest.

    The torque of the first step is F_K, which differs from the converging one by second order
    in dt and leaves some 1e-7 rad.
    """
    dt = 1e-4
    # sigma = 0 holds x_h at xd + Td/K0; the wall is out of reach
    p = Params(xd=e0, Td=1e-9, sigma=0.0, gap=10.0, Kenv=0.0, Denv=0.0)
    w = np.sqrt(slope / 10.0)
    n = int(np.pi / w / dt)
    s = rollout(p, model=Model(law=law), dt=dt, n_steps=n)
    exact = 0.5 * e0 * (1 + np.cos(w * s.t))
    np.testing.assert_allclose(s.e, exact, atol=1e-6)
    assert abs(s.v[-1]) < e0 * w**2 * dt  # arrives with zero speed, to within the last step
    assert abs(s.e[-1]) < 1e-6  # at x_h
    assert not s.diverging[1:].any()


def test_the_work_of_a_release_is_the_kinetic_energy():
    """From rest, the work so far equals I v^2/2: RK4 integrates both to 1e-8 J."""
    p = Params(xd=0.3, Td=1e-9, sigma=0.0, gap=10.0, Kenv=0.0, Denv=0.0)
    s = rollout(p, model=Model(law="effort"), dt=1e-4, n_steps=3141)
    kinetic = 0.5 * 10.0 * s.v**2
    np.testing.assert_allclose(np.cumsum(s.work), kinetic, atol=1e-8)


@pytest.mark.parametrize("K0", [1.0, 100.0, 1000.0])  # 1000: K0 x0 > Fmax, non-monotone
def test_force_is_the_slope_of_energy(K0):
    """dE/de = F for all e, by automatic and by numerical differentiation and by quadrature."""
    p = Params(K0=K0)
    e = jnp.linspace(-0.2, 0.2, 4001)
    slope = jax.vmap(jax.grad(lambda e: energy(e, p)))(e)
    np.testing.assert_allclose(slope, jax.vmap(lambda e: force(e, p))(e), rtol=1e-12, atol=1e-6)
    middle = 0.5 * (e[1:] + e[:-1])
    h = 1e-6
    F = jax.vmap(lambda e: force(e, p))(middle)
    numeric = (energy(middle + h, p) - energy(middle - h, p)) / (2 * h)
    smooth = (abs(abs(middle) - 0.1) > 1e-5) & (abs(abs(middle) - 0.11) > 1e-5)
    np.testing.assert_allclose(numeric[smooth], F[smooth], rtol=1e-4, atol=1e-4)


def test_force_and_energy_at_points_computed_by_hand():
    """Eq. 1 and 2 by hand: K0 = 100, Fmax = 15, x0 = 0.1, xb = 0.11, S = 20."""
    p = Params()
    assert force(0.05, p) == pytest.approx(5.0)
    assert force(-0.05, p) == pytest.approx(-5.0)
    assert force(0.105, p) == pytest.approx(5.0 * (1 - np.exp(-10.0)) + 10.0)
    assert force(0.2, p) == pytest.approx(15.0)
    assert energy(0.05, p) == pytest.approx(0.125)
    assert energy(0.2, p) == pytest.approx(15 * 0.1 + 0.5 - 5e-4 * 5 * (1 - np.exp(-20.0)))
    assert force(0.1069078, p) == pytest.approx(0.999999 * 15.0, rel=1e-6)  # before xb (C11)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_profile_is_continuous_at_x0_and_xb(sign):
    """At x0 exactly; at xb up to dF exp(-S), the 2e-9 that eq. 1 leaves of it."""
    p = Params()
    tiny = 1e-12
    for f, bound in ((force, 5.0 * np.exp(-20.0) + 1e-7), (energy, 1e-10)):
        for edge in (p.x0, p.xb):
            below, above = f(sign * (edge - tiny), p), f(sign * (edge + tiny), p)
            assert abs(below - above) < bound


@pytest.mark.parametrize("law", ["algorithm1", "effort"])
@pytest.mark.parametrize("peak", [0.05, 0.09, 0.103, 0.2, -0.15])
def test_torque_is_continuous_at_the_switch(law, peak):
    """At e = e_M the converging torque is F_K(e_M) ("perfectly superimposed", Fig. 2b)."""
    p, model = Params(), Model(law=law)
    moving_away = begin_branch(peak, departs(peak, 0.0, model), 0.0, p, model)
    coming_back = begin_branch(
        peak, departs(peak, np.sign(peak) * 1e-9, model), moving_away.e_M, p, model
    )
    assert bool(moving_away.diverging)
    assert not bool(coming_back.diverging)
    out, back = (float(torque(peak, a, p)) for a in (moving_away, coming_back))
    assert out == pytest.approx(back, rel=1e-14)  # a few units in the last place
    assert out == pytest.approx(float(force(peak, p)), rel=1e-14)


def test_the_torque_of_the_law_energy_jumps_at_the_switch():
    """`energy`, the older law, beyond x0: Algorithm 1 was made to remove this jump."""
    p, model = Params(), Model(law="energy")
    away = begin_branch(0.3, TRUE, 0.0, p, model)
    back = begin_branch(0.3, ~TRUE, away.e_M, p, model)
    assert torque(0.3, away, p) == pytest.approx(15.0)
    expected = float(2 * energy(0.3, p) / 0.3)  # above Fmax, so limited
    assert torque(0.3, back, p) == pytest.approx(min(expected, 15.0))
    deep = begin_branch(0.12, TRUE, 0.0, p, model)
    inside = replace(deep, diverging=jnp.array(False))
    assert torque(0.12, inside, p) == pytest.approx(float(2 * energy(0.12, p) / 0.12))
