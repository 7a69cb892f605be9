"""What JAX does to the functions: compile, batch, differentiate, chunk, without changing them."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fic_jax
from fic_jax import (
    CHOICES,
    METRICS,
    Model,
    Params,
    ParamsError,
    control,
    evaluate,
    init,
    rollout,
)
from fic_jax import (
    lanes as native,
)
from fic_jax import step as public_step
from fic_jax.engine import _compiled
from fic_jax.engine.xla import BLOCKS, LANES
from fic_jax.profile import energy, force
from tests.streamed import streamed

DT = 0.01
TRACED = []  # names of the functions that JAX has traced since this module was imported
COMPILED = []


def note(event, seconds, fun_name="", **details):
    if event == "/jax/core/compile/jaxpr_trace_duration":
        TRACED.append(fun_name)
    if event == "/jax/core/compile/backend_compile_duration":
        COMPILED.append("rollout" if "rollout" in fun_name else fun_name)


jax.monitoring.register_event_duration_secs_listener(note)
APPROACH = Params(K0=100.0, Kenv=500.0, Td=5.0, gap=0.5, xd=0.5)


def random_batch(n, seed=0, dtype=np.float64):
    rng = np.random.default_rng(seed)
    columns = {
        "K0": np.exp(rng.uniform(0.0, 6.9, n)),
        "Kenv": rng.uniform(10.0, 800.0, n),
        "Denv": rng.uniform(0.0, 300.0, n),
        "Td": rng.uniform(1.0, 20.0, n),
        "gap": rng.choice([0.0, 0.5], n),
        "period": DT * rng.integers(1, 10, n),
    }
    return Params(**{name: column.astype(dtype) for name, column in columns.items()})


def pick(batch, index):
    return Params(**{k: v[index] if np.ndim(v) else v for k, v in vars(batch).items()})


def assert_same(one, other):
    for name in METRICS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


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


@pytest.mark.parametrize("arrangement", ["native", "scan"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scenario_alone_equals_its_lane_among_many(arranged, arrangement, dtype):
    """Bit for bit, whatever its neighbours, its place, the number of scenarios and of calls."""
    arranged(arrangement)
    n = 2 * BLOCKS["scan"] * LANES + 77  # more than one call of the program, with a ragged end
    batch = random_batch(n, dtype=dtype)
    whole = fic_jax.sweep(batch, dt=DT, n_steps=60)
    assert whole.nmse.dtype == dtype
    for index in (0, 1, LANES, n // 2, n - 1):
        alone = fic_jax.sweep(pick(batch, slice(index, index + 1)), dt=DT, n_steps=60)
        assert_same(alone, jax.tree.map(lambda a, i=index: a[i : i + 1], whole))
    order = np.random.default_rng(1).permutation(n)
    shuffled = fic_jax.sweep(pick(batch, order), dt=DT, n_steps=60)
    assert_same(shuffled, jax.tree.map(lambda a: a[order], whole))


@pytest.mark.parametrize(("lanes", "blocks"), [(32, 4), (64, 128), (256, 16)])
def test_any_block_size_gives_the_same_bits(arranged, lanes, blocks, monkeypatch):
    batch = random_batch(700)
    arranged("scan")
    chosen = fic_jax.sweep(batch, dt=DT, n_steps=60)
    monkeypatch.setattr(fic_jax.engine.xla, "LANES", lanes)
    monkeypatch.setitem(BLOCKS, "scan", blocks)
    _compiled.cache_clear()
    assert_same(fic_jax.sweep(batch, dt=DT, n_steps=60), chosen)


@pytest.mark.parametrize(("registers", "part"), [(2, 4096), (1, 8), (4, 100)])
def test_any_length_of_vectors_gives_the_same_bits(arranged, registers, part, monkeypatch):
    batch = random_batch(700)
    chosen = fic_jax.sweep(batch, dt=DT, n_steps=60)
    monkeypatch.setattr(fic_jax.engine, "REGISTERS", registers)
    monkeypatch.setattr(native, "PART", part)
    arranged("native")
    assert_same(fic_jax.sweep(batch, dt=DT, n_steps=60), chosen)


@pytest.mark.parametrize("arrangement", ["native", "scan"])
def test_no_scenarios_have_no_metrics(arranged, arrangement):
    arranged(arrangement)
    metrics = fic_jax.sweep(Params(K0=np.zeros(0)), dt=DT, n_steps=3)
    assert {leaf.shape for leaf in jax.tree.leaves(metrics)} == {(0,)}


@pytest.mark.parametrize("wrong", [0, -1, 1.5])
def test_substeps_are_counted(wrong):
    with pytest.raises(ParamsError, match="`substeps` must be a whole number, at least 1"):
        evaluate(APPROACH, dt=DT, n_steps=10, substeps=wrong)


WITH_A_FLAG = """
import os, sys, warnings
os.environ["XLA_FLAGS"] = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true"
import fic_jax
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    fic_jax.tune_for_throughput(1)
assert len(told) == 1 and "XLA_FLAGS already has" in str(told[0].message), told
assert os.environ["XLA_FLAGS"].count("extra_options") == 1
"""


def test_flags_already_there_are_kept_with_a_warning():
    subprocess.run([sys.executable, "-c", WITH_A_FLAG], check=True)


WITHOUT_FLAGS = """
import os, sys, warnings
import numpy as np
import fic_jax.engine
fic_jax.engine.TRIED_JAXLIB = ("0.0.",)
fic_jax.engine.ARRANGEMENT["cpu"] = "scan"
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    fic_jax.tune_for_throughput(2)
assert len(told) == 1 and "was not tried" in str(told[0].message), told
assert "xla_cpu_small_while_loop" not in os.environ.get("XLA_FLAGS", "")
K0 = np.geomspace(5.0, 500.0, 200).astype(np.float32)
metrics = fic_jax.sweep(fic_jax.Params(K0=K0), dt=0.01, n_steps=60)
assert len(fic_jax.engine.jax.local_devices()) == 2
sys.stdout.write(metrics.nmse.tobytes().hex())
"""


def test_an_untried_jaxlib_runs_without_the_flags():
    """One warning, both devices, and the numbers of the vector kernel to a few ulp."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    command = [sys.executable, "-c", WITHOUT_FLAGS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    plain = np.frombuffer(bytes.fromhex(done.stdout), np.float32)
    K0 = np.geomspace(5.0, 500.0, 200).astype(np.float32)
    ours = fic_jax.sweep(Params(K0=K0), dt=np.float32(DT), n_steps=60).nmse
    assert ours.dtype == np.float32
    np.testing.assert_allclose(ours, plain, rtol=16 * np.finfo(np.float32).eps)


@pytest.mark.parametrize("arrangement", ["native", "scan"])
def test_one_device_equals_two(arranged, arrangement, monkeypatch):
    batch = random_batch(1000)
    arranged(arrangement)
    both = fic_jax.sweep(batch, dt=DT, n_steps=60)
    assert jax.local_device_count() == 2
    one = jax.local_devices()[:1]
    monkeypatch.setattr(jax, "local_devices", lambda: one)
    assert_same(fic_jax.sweep(batch, dt=DT, n_steps=60), both)


def test_evaluate_equals_the_metrics_of_a_rollout():
    """Two programs, on regular scenarios, to rounding."""
    batch = random_batch(16)
    for i in range(16):
        p = fic_jax.params.canonical(pick(batch, i))
        samples = rollout(p, dt=DT, n_steps=200)
        expected = streamed(p, samples, jnp.float64(DT), Model())
        got = evaluate(p, dt=DT, n_steps=200)
        for name in METRICS:
            np.testing.assert_allclose(
                getattr(got, name), getattr(expected, name), rtol=1e-9, atol=1e-12, err_msg=name
            )


def test_sweep_equals_evaluate():
    """The arranged engine and the plain public function, on regular scenarios, to rounding."""
    batch = random_batch(16)
    swept = fic_jax.sweep(batch, dt=DT, n_steps=200)
    for i in range(16):
        single = evaluate(pick(batch, i), dt=DT, n_steps=200)
        for name in METRICS:
            np.testing.assert_allclose(
                getattr(swept, name)[i], getattr(single, name), rtol=1e-9, atol=1e-12
            )


def test_values_never_recompile():
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


def test_float32_sums_hold_over_long_runs():
    """100,000 samples: plain float32 additions were off by 1e-3, compensated ones are rounded."""
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
def test_derivative_forward_reverse_and_central_difference_agree(name):
    """Away from switches: welded, from rest, before the first v = 0."""

    def loss(value):
        p = Params(**{"Td": 6.0, "xd": 0.0, name: value})
        return evaluate(p, model=Model(contact="welded"), dt=DT, n_steps=40).nmse

    value = float(getattr(Params(), name))
    forward, reverse = jax.jvp(loss, (value,), (1.0,))[1], jax.grad(loss)(value)
    h = 1e-6 * max(value, 1e-2)
    central = (loss(value + h) - loss(value - h)) / (2 * h)
    # central differences of a smooth float64 function are good to about (1e-16/h)^(2/3)
    # below 1e-14 stands a zero: in the linear zone nmse does not depend on Td
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-9)


def test_dtype_follows_the_parameters():
    single = jax.tree.map(np.float32, APPROACH)
    assert evaluate(single, dt=DT, n_steps=5).nmse.dtype == np.float32
    assert evaluate(APPROACH, dt=DT, n_steps=5).nmse.dtype == np.float64
    assert fic_jax.sweep(random_batch(3, dtype=np.float32), dt=DT, n_steps=5).nmse.dtype == "f4"
    assert fic_jax.sweep(Params(K0=[100, 200]), dt=DT, n_steps=5).nmse.shape == (2,)


def test_control_is_the_controller_of_step():
    """On the same plant `control` gives what `step` does: decisions bit for bit."""
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


def test_time_is_a_multiple_not_a_sum():
    t = np.asarray(rollout(jax.tree.map(np.float32, APPROACH), dt=DT, n_steps=1000).t)
    np.testing.assert_array_equal(t, np.arange(1, 1001, dtype=np.float32) * np.float32(DT))


def test_diverged_scenario_is_told_and_leaves_its_neighbours_alone():
    """A weld so stiff that dt can't resolve it: RK4 blows up and `finite` says so."""
    batch, model = Params(Kenv=np.array([100.0, 1e9, 500.0])), Model(contact="welded")
    metrics = fic_jax.sweep(batch, model=model, dt=DT, n_steps=200)
    np.testing.assert_array_equal(metrics.finite, [True, False, True])
    alone = fic_jax.sweep(pick(batch, slice(0, 1)), model=model, dt=DT, n_steps=200)
    assert_same(alone, jax.tree.map(lambda a: a[:1], metrics))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"I": [1.0, -1.0]}, "`I` must be positive and finite, but is -1"),
        ({"xb": 0.05}, "`xb` must be greater than x0 = 0.1, but is 0.05"),
        ({"Td": 0.0}, "`Td` must be non-zero"),
        ({"K0": np.nan}, "`K0` must be positive and finite, but is nan"),
        ({"K0": [1.0, 2.0], "Td": [1.0, 2.0, 3.0]}, "`batch` must be scalars and"),
        ({"K0": [[1.0, 2.0]]}, "`batch` must be scalars and"),
        ({"period": 0.015}, r"`period` must be a whole multiple of dt = 0.01 s \(nearest: 0.02\)"),
    ],
)
def test_sweep_refuses_what_no_scenario_may_have(bad, message):
    columns = {name: np.asarray(value, float) for name, value in bad.items()}
    with pytest.raises(ParamsError, match=message):
        fic_jax.sweep(Params(**columns), dt=DT, n_steps=5)


def test_model_refuses_an_unknown_choice():
    with pytest.raises(ParamsError, match="`law` must be one of algorithm1, effort, energy"):
        Model(law="algorithm2")
    assert hash(Model()) == hash(Model(law="algorithm1"))
