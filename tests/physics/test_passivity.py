"""The Lyapunov function: its potential is that of the torque; V is continuous at the peak."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fic_jax import CHOICES, Model, Params, energy
from fic_jax.controller import begin_branch, torque
from fic_jax.params import canonical
from fic_jax.passivity import lyapunov, potential, stored
from tests.physics.test_laws import numbers, scenarios

law = settings(max_examples=100, deadline=None, derandomize=True)
laws = pytest.mark.parametrize("model", [Model(law=name) for name in CHOICES["law"]], ids=str)


def of_branch(function):
    """`function(e, attractor, p)` of an attractor given by its branch and peak, jitted."""

    @partial(jax.jit, static_argnames="model")
    def at(e, diverging, e_M, p, model):
        return function(e, begin_branch(e_M, diverging, e_M, p, model), p)

    return lambda e, diverging, e_M, p, model: at(
        jnp.float64(e), jnp.bool_(diverging), jnp.float64(e_M), canonical(p), model
    )


torque_at, potential_at, stored_at = (of_branch(f) for f in (torque, potential, stored))
slope_at = of_branch(jax.grad(potential))
along = of_branch(jax.vmap(torque, in_axes=(0, None, None)))


@laws
@law
@given(p=scenarios(), e=numbers(-1.0, 1.0), e_M=numbers(-1.0, 1.0), diverging=st.booleans())
def test_the_slope_of_the_potential_is_the_torque(model, p, e, e_M, diverging):
    """dU/de = torque, except within 1e-7 rad of a jump of the torque (1e-3 Fmax or more)."""
    beside = [float(torque_at(e + s, diverging, e_M, p, model)) for s in (-1e-7, 1e-7)]
    if np.isclose(*beside, rtol=0.0, atol=1e-3 * p.Fmax):
        slope = float(slope_at(e, diverging, e_M, p, model))
        assert slope == pytest.approx(np.mean(beside), abs=2e-3 * p.Fmax)


@laws
@law
@given(p=scenarios(), e=numbers(-1.0, 1.0), e_M=numbers(-1.0, 1.0))
def test_the_potential_is_the_work_of_the_torque(model, p, e, e_M):
    """U(e) is the integral of the converging torque from 0, across its jumps too.

    Each jump, at most 2 Fmax, is in one interval of the trapezium rule: two intervals' error.
    """
    nodes = np.linspace(0.0, e, 4001)
    work = np.trapezoid(along(nodes, False, e_M, p, model), nodes)
    slack = 4.0 * p.Fmax * abs(nodes[1]) + 1e-12
    assert float(potential_at(e, False, e_M, p, model)) == pytest.approx(work, abs=slack)


@laws
@law
@given(p=scenarios(), e_M=numbers(-1.0, 1.0))
def test_v_is_continuous_at_the_peak(model, p, e_M):
    """By the choice of E_C, to rounding. If K0 x0 <= Fmax, V is E_K(e_M) at the peak."""
    out, back = (float(stored_at(e_M, side, e_M, p, model)) for side in (True, False))
    assert out == pytest.approx(back, rel=1e-12, abs=1e-15)
    if p.K0 * p.x0 <= p.Fmax:
        assert out == pytest.approx(float(energy(e_M, p)), rel=1e-12, abs=1e-15)


@law
@given(p=scenarios(), share=numbers(0.01, 1.0))
def test_v_at_the_end_of_a_convergence_in_the_linear_zone_is_the_stored_energy(p, share):
    """V_AA(0) = E_K(e_M), not 0 as the appendix has it: F_AA is odd about e_M/2."""
    e_M = share * min(p.x0, p.Fmax / p.K0)
    left = float(stored_at(0.0, False, e_M, p, Model()))
    assert left == pytest.approx(0.5 * p.K0 * e_M**2, rel=1e-9)  # rounding


def test_v_adds_the_kinetic_energy():
    p = Params()
    attractor = begin_branch(0.05, True, 0.05, p, Model())
    total = float(lyapunov(0.05, 2.0, attractor, p))
    assert total == pytest.approx(0.5 * p.I * 2.0**2 + 0.5 * p.K0 * 0.05**2, rel=1e-12)


def test_gradients_of_the_potential_are_finite_at_its_edges():
    slope = of_branch(jax.vmap(jax.grad(stored), in_axes=(0, None, None)))
    p = Params()
    for e_M in (0.0, p.x0, p.xb, 0.3):
        e = np.array([0.0, 0.5 * e_M, p.x0, p.xb, -0.3])
        assert np.isfinite(slope(e, False, e_M, p, Model())).all()
