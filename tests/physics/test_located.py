"""`rk4_events`: against scipy with events, and at exact crossing times."""

from dataclasses import replace
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax import Model, Params, energy, force, rollout
from fic_jax.stiffness import fastest_rate
from tests.reference import events
from tests.reference.scenarios import CHOICES, random_params
from tests.reference.sensitivity import scale, sensitivity

EVENTS = Model(integrator="rk4_events")
NO_TORQUE = {"K0": 1e-12, "Fmax": 1e-12, "Td": 1e-12, "xd": 10.0, "sigma": 0.0}
DT = 0.01


@partial(jax.jit, static_argnames=("model", "n_steps"))
def simulate(batch, dt, model, n_steps):
    return jax.vmap(partial(rollout, model=model, dt=dt, n_steps=n_steps))(batch)


def batch_of(n, **leaves):
    """Params with [n] leaves."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.float64(leaf), (n,)), Params(**leaves))


# The independent solver --------------------------------------------------------------------------

# Every option, and every pair of options of the first three choices: a Latin square.
VARIANTS = [
    {
        "contact": CHOICES["contact"][i],
        "law": CHOICES["law"][j],
        "divergence": CHOICES["divergence"][(i + j) % 3],
        "peak": CHOICES["peak"][(i + 2 * j) % 2],
        "feedback": CHOICES["feedback"][(i * j) % 2],
        "expectation": CHOICES["expectation"][(i + j) % 2],
    }
    for i, j in product(range(3), range(3))
]
T_END = 1.0
PER_VARIANT = 8


@pytest.mark.parametrize("third", range(3))
def test_follows_scipy_with_events_in_all_variants(third):
    """x(t) at every 10 ms, in parts of its range: median 1e-4, 90th percentile 5e-3.

    Measured 4e-6 to 3e-5 and 1e-3 to 2e-3; rk4 has 4e-3 and 5e-2. As in test_reference, scenarios
    with a sensitivity above 10 or without a limit are excluded: a third at most.
    """
    rng = np.random.default_rng(third)
    n_steps, errors, apart = round(T_END / DT), [], 0
    times = DT * np.arange(1, n_steps + 1)
    for choices in VARIANTS[third::3]:
        params = [random_params(rng) for _ in range(PER_VARIANT)]
        batch = Params(**{name: jnp.array([p[name] for p in params]) for name in params[0]})
        model = Model(**choices, integrator="rk4_events")
        ours = np.asarray(simulate(batch, DT, model, n_steps).x)
        for p, x in zip(params, ours, strict=True):
            try:
                exact = events.simulate(p, choices, T_END, times)["x"]
            except events.Irregular:
                apart += 1
                continue
            error = np.max(np.abs(x - exact)) / scale(exact)
            if error > 1e-3 and sensitivity(p, choices, T_END) > 10.0:
                apart += 1
            else:
                errors.append(error)
    assert apart <= PER_VARIANT
    assert np.median(errors) < 1e-4
    assert np.percentile(errors, 90) < 5e-3


# Exact crossing times ----------------------------------------------------------------------------

# Motions so slow that RK4 itself errs by less than 1e-10: (w dt)^4 = 6e-10, some hundredth of it
# in a period. The rest is the error of the crossing time: 1e-10 s, times speeds below 1 rad/s.
# Sixteen scenarios cross at sixteen phases of the step.
PHASES = 16
SLOW = 0.5  # rad/s
EXACT = 1e-10  # rad


def into_the_wall(t, contact, zeta, v, gap):
    """x(t) of a mass that flies at speed v into a spring and damper at `gap`, and out again."""
    wd, decay = SLOW * np.sqrt(1.0 - zeta**2), zeta * SLOW
    s = t - gap / v  # since the touch
    damped = v / wd * np.exp(-decay * s) * np.sin(wd * s)
    if contact == "damped_rebound":
        leave = np.pi / wd
        inside = np.where(s < leave, damped, -v * np.exp(-decay * leave) * (s - leave))
    else:  # no damping on the way back: a quarter of a swing
        turn, quarter = np.arctan2(wd, decay) / wd, 0.5 * np.pi / SLOW
        depth = v / wd * np.exp(-decay * turn) * np.sin(wd * turn)
        back = depth * np.cos(SLOW * (s - turn))
        away = -depth * SLOW * (s - turn - quarter)
        inside = np.where(s < turn, damped, np.where(s < turn + quarter, back, away))
    return gap + np.where(s < 0.0, v * s, inside)


@pytest.mark.parametrize(
    ("contact", "zeta"), [("hard_stop", 0.0), ("hard_stop", 0.3), ("damped_rebound", 0.3)]
)
def test_touching_turning_and_leaving_at_their_exact_times(contact, zeta):
    """Three switches in a row; without damping the hard stop is left pi/w after the touch."""
    inertia, gap, v = 10.0, 0.5, np.linspace(0.61, 0.8, PHASES)
    spring = {"Kenv": inertia * SLOW**2, "Denv": 2.0 * zeta * SLOW * inertia}
    p = batch_of(PHASES, **NO_TORQUE, **spring, I=inertia, gap=gap, v_init=v)
    located = simulate(p, DT, Model(contact=contact).with_events(), 900)
    exact = into_the_wall(np.asarray(located.t), contact, zeta, v[:, None], gap)
    assert (exact[:, -1] < gap).all()  # all have left
    np.testing.assert_allclose(located.x, exact, rtol=0.0, atol=EXACT)
    late = simulate(p, DT, Model(contact=contact), 900)
    assert np.max(np.abs(late.x - exact)) > 1e3 * EXACT


@pytest.mark.parametrize(
    ("law", "e0"), [("effort", 0.3), ("effort", 0.6), ("energy", 0.12), ("algorithm1", 0.12)]
)
def test_release_passes_the_end_of_the_spring_at_its_exact_time(law, e0):
    """e = e0 (1 + cos w t)/2 beyond x0, from the first step on; `algorithm1` then changes slope."""
    p = Params()
    effort, energy_ = 2.0 * force(e0, p) / e0, 4.0 * energy(e0, p) / e0**2
    outer, inner = (
        float(energy_ if law == "energy" else effort),
        float(effort if law == "effort" else energy_),
    )
    inertia = np.linspace(1.0, 1.2, PHASES) * outer / SLOW**2
    free = {"gap": 10.0, "Kenv": 0.0, "Denv": 0.0, "sigma": 0.0, "Td": 1e-14}
    s = simulate(batch_of(PHASES, **free, xd=e0, I=inertia), DT, Model(law=law).with_events(), 700)
    t, h, x0 = np.asarray(s.t), 0.5 * e0, p.x0
    w1, w2 = (np.sqrt(slope / inertia)[:, None] for slope in (outer, inner))
    t1 = np.arccos((x0 - h) / h) / w1
    rate = -h * w1 * np.sin(w1 * t1)
    slower = h + (x0 - h) * np.cos(w2 * (t - t1)) + rate / w2 * np.sin(w2 * (t - t1))
    exact = np.where(t < t1, h + h * np.cos(w1 * t), slower)
    coming = np.logical_and.accumulate(exact > 1e-3 * e0, axis=1)  # until close to x_h
    assert (np.min(np.where(coming, exact, e0), axis=1) < 0.01 * e0).all()
    np.testing.assert_allclose(np.where(coming, s.e, exact), exact, rtol=0.0, atol=EXACT)


@pytest.mark.parametrize("v", [-0.02, 0.05])
def test_passing_the_reference_and_turning_at_their_exact_times(v):
    """Converging, through e = 0, diverging (at 0.05 rad/s beyond |e| = x0), turning, converging.

    Algorithm 1 starts with e_M = e and slope 2 K0 about e_M/2. Fmax makes the
    profile K0 x0 beyond x0, to 1e-12.
    """
    K0, x0, e0, sign = 100.0, 0.1, 0.01, np.sign(v)
    inertia = np.linspace(1.0, 1.5, PHASES) * 2.0 * K0 / SLOW**2
    profile = {"K0": K0, "x0": x0, "Fmax": K0 * x0 * (1.0 + 1e-12), "xb": 0.2, "S": 1.0}
    free = {"gap": 10.0, "Kenv": 0.0, "Denv": 0.0, "sigma": 0.0, "Td": 1e-14}
    p = batch_of(PHASES, **profile, **free, xd=sign * e0, I=inertia, v_init=v)
    s = simulate(p, DT, Model(law="effort", contact="welded").with_events(), 1000)
    t, inertia = np.asarray(s.t), inertia[:, None]
    w1, w2 = np.sqrt(2.0 * K0 / inertia), np.sqrt(K0 / inertia)
    half, u = 0.5 * e0, abs(v)  # at e = 0 it has its speed again
    swing, phase = np.hypot(half, u / w1), np.arctan2(u / w1, half)
    passed = (np.arccos(-half / swing) - phase) / w1
    coming = half + swing * np.cos(w1 * t + phase)
    going = -u / w2 * np.sin(w2 * (t - passed))
    peak, turn, F_M = u / w2, passed + 0.5 * np.pi / w2, K0 * u / w2
    if abs(v) == 0.05:
        assert (peak > x0).all()
        beyond = passed + np.arcsin(x0 / peak) / w2
        u, a = np.sqrt(u**2 - (w2 * x0) ** 2), K0 * x0 / inertia
        steady = -x0 - u * (t - beyond) + 0.5 * a * (t - beyond) ** 2
        going = np.where(t < beyond, going, steady)
        peak, turn, F_M = x0 + 0.5 * u**2 / a, beyond + u / a, K0 * x0
    w3 = np.sqrt(2.0 * F_M / peak / inertia)
    back = -0.5 * peak * (1.0 + np.cos(w3 * (t - turn)))
    exact = np.where(t < passed, coming, np.where(t < turn, going, back))
    before = t < turn + 0.9 * np.pi / w3  # it arrives at e = 0 at rest, where two switches meet
    assert (turn < t[:, -1:]).all()
    np.testing.assert_allclose(np.where(before, sign * s.e, exact), exact, rtol=0.0, atol=EXACT)


@pytest.mark.parametrize(
    ("integrator", "lowest", "highest"), [("rk4", 0.8, 1.2), ("rk4_events", 4.0, 6.0)]
)
def test_order_at_a_crossing(integrator, lowest, highest):
    """Mean error behind one contact over 32 phases, 8 to 1 ms: first order, and four or more."""
    w, zeta, v, t_end, phases = 10.0, 0.4, 1.0, 0.2, 32
    gap = 0.1 - 0.008 * (np.arange(phases) + 0.5) / phases
    wd, s = w * np.sqrt(1.0 - zeta**2), t_end - gap / v
    exact = gap + v / wd * np.exp(-zeta * w * s) * np.sin(wd * s)
    wall = {"I": 10.0, "Kenv": 10.0 * w**2, "Denv": 2.0 * zeta * w * 10.0}
    p = batch_of(phases, **NO_TORQUE, **wall, gap=gap, v_init=v, period=t_end)
    steps, errors = [25, 50, 100, 200], []
    for n in steps:  # always 200 steps, which is one program
        x = simulate(p, t_end / n, Model(integrator=integrator), steps[-1]).x[:, n - 1]
        errors.append(np.mean(np.abs(x - exact)))
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert lowest < order < highest


@pytest.mark.parametrize("S", [20.0, 1.0])
def test_order_through_the_end_of_the_profile(S):
    """|e| = xb, where eq. 1 jumps by dF exp(-S) and its slope by dF/b exp(-S): order two or more.

    Free and diverging from |e| < x0 to beyond xb, against 16 times the steps.
    """
    phases, t_end = 16, 0.3
    v = -1.0 - 0.05 * np.arange(phases) / phases
    p = batch_of(phases, gap=10.0, sigma=0.0, xd=-0.05, S=S, xb=0.2, v_init=v, period=t_end)
    steps, errors = [60, 120, 240], []  # 30: the bend is swept
    fine = simulate(p, t_end / 1920, EVENTS, 1920).x[:, -1]
    assert (np.abs(fine) > 0.25).all()
    for n in steps:  # always 240 steps, which is one program
        x = simulate(p, t_end / n, EVENTS, steps[-1]).x[:, n - 1]
        errors.append(np.mean(np.abs(x - fine)))
    assert -np.polyfit(np.log(steps), np.log(errors), 1)[0] > 2.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_slow_motion_off_the_wall_is_not_pulled(dtype):
    """x = gap at -1 mm/s: the point ahead has to lie outside the wall in single precision too."""
    p = Params(**NO_TORQUE, gap=0.5, x_init=0.5, v_init=-1e-3)
    p = jax.tree.map(dtype, p)
    s = rollout(p, model=Model(contact="damped_rebound").with_events(), dt=dtype(DT), n_steps=3)
    np.testing.assert_allclose(s.v, -1e-3, rtol=1e-6)


# Gradients ---------------------------------------------------------------------------------------

WALL = ("gap", "Kenv", "v_init")


def last_x(p, dt):
    return rollout(p, model=EVENTS, dt=dt, n_steps=40).x[-1]


backward = jax.jit(jax.vmap(jax.value_and_grad(last_x), in_axes=(0, None)))


@jax.jit
def forward(p, along):
    return jax.vmap(lambda p, d: jax.jvp(lambda p: last_x(p, DT), (p,), (d,))[1])(p, along)


def test_gradients():
    """Both in one test: a gradient takes long to compile."""
    gradients_through_a_located_contact_are_right()
    gradients_are_finite_where_switches_meet_or_nothing_happens()


def gradients_through_a_located_contact_are_right():
    """dx(0.4 s) by jvp, by grad and by central differences of the same program, 1e-6 relative.

    Changes of 1e-6 leave 1e-10 by rounding, on slopes down to 2e-3; that of Kenv is 1e-5 and takes
    a change of 1e-3.
    """
    gap, Kenv, v = [0.053, 0.1212, 0.08, 0.1], [300.0, 80.0, 500.0, 50.0], [0.6, 0.9, 0.5, 1.2]
    drawn = {"gap": gap * 2, "Kenv": Kenv * 2, "v_init": v * 2, "Denv": [20.0] * 4 + [189.7] * 4}
    p = batch_of(8, **{name: np.array(values) for name, values in drawn.items()})
    slopes = backward(p, DT)[1]
    for name, change in zip(WALL, (1e-6, 1e-3, 1e-6), strict=True):
        unit = replace(jax.tree.map(jnp.zeros_like, p), **{name: jnp.ones(8)})
        up, down = (jax.tree.map(lambda a, b, s=s: a + s * b, p, unit) for s in (change, -change))
        numeric = (backward(up, DT)[0] - backward(down, DT)[0]) / (2.0 * change)
        np.testing.assert_allclose(forward(p, unit), getattr(slopes, name), rtol=1e-9)
        np.testing.assert_allclose(getattr(slopes, name), numeric, rtol=1e-6)


def gradients_are_finite_where_switches_meet_or_nothing_happens():
    """No event, a crossing on a step's end, x = gap or e = 0 or |e| = x0 at the start, at rest."""
    cases = [
        Params(**NO_TORQUE, gap=10.0, v_init=0.1),  # no event
        Params(**NO_TORQUE, gap=0.25, v_init=0.5),  # touches at the end of step 32, in binary
        Params(),  # at rest on the wall
        Params(v_init=0.5),
        Params(v_init=-0.5),
        Params(xd=-0.05, gap=10.0),  # at rest at x_h
        Params(xd=0.05, gap=10.0),  # at rest where |e| = x0
        Params(**NO_TORQUE | {"xd": -1.0}, gap=10.0),  # nothing pushes
    ]
    dt = 1.0 / 64.0
    p = jax.tree.map(lambda *leaves: jnp.array(leaves, jnp.float64), *cases)
    values, slopes = backward(replace(p, period=jnp.full(len(cases), dt)), dt)
    assert jnp.isfinite(values).all()
    for name, slope in vars(slopes).items():
        assert jnp.isfinite(slope).all(), name


# Several switches in a step -----------------------------------------------------------------------


@pytest.mark.parametrize("contact", ["hard_stop", "damped_rebound"])
def test_several_crossings_in_a_step_err_by_a_step_at_most(contact):
    """dt = 50 ms on walls that RK4 just resolves: contact, v = 0 and e = 0 in one step, for 1 s.

    A switch that acts one step late errs by the way of one step. The median error is less (measured
    0.3 ways); the largest, after several bounces, is 5 ways.
    """
    n, dt, refined = 32, 0.05, 32
    rng = np.random.default_rng(3)
    p = batch_of(
        n,
        period=dt,
        gap=rng.uniform(0.05, 0.3, n),
        K0=np.exp(rng.uniform(0.0, np.log(150.0), n)),
        xb=0.3,
        S=2.0,
        Kenv=np.exp(rng.uniform(np.log(1e3), np.log(1.5e4), n)),
        Denv=rng.choice([0.0, 10.0, 190.0], n),
        v_init=rng.uniform(0.5, 2.0, n),
    )
    assert fastest_rate(p) * dt < 2.5  # RK4 is stable up to 2.8
    model = Model(contact=contact).with_events()
    seen = slice(refined - 1, None, refined)
    fine = simulate(p, dt / refined, model, 20 * refined)
    coarse = jax.tree.map(lambda leaf: leaf[:, :20], simulate(p, dt, model, 20 * refined))
    way = dt * np.max(np.abs(fine.v), axis=1)
    error = np.max(np.abs(coarse.x - fine.x[:, seen]), axis=1)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(coarse))
    assert np.median(error / way) < 1.0
    assert np.max(error / way) < 10.0


def test_a_sliding_motion_stays_finite_and_bounded():
    """`energy` with K0 x0 > Fmax: both sides of v = 0 lead back to it, and no limit exists."""
    n = 32
    rng = np.random.default_rng(1)
    p = batch_of(
        n,
        K0=rng.uniform(200.0, 1000.0, n),
        v_init=rng.uniform(-1.0, 1.0, n),
        x_init=rng.uniform(-0.3, 0.3, n),
        gap=rng.uniform(0.0, 0.3, n),
    )
    s = simulate(p, DT, Model(law="energy").with_events(), 300)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(s))
    assert np.max(np.abs(s.x)) < 2.0
