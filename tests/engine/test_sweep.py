"""`sweep`: a scenario's bits depend on the scenario only; backends, devices, errors."""

import os
import subprocess
import sys
import warnings
from dataclasses import replace

import jax
import numpy as np
import pytest

from fic_jax import METRICS, Model, Params, ParamsError, evaluate, sweep
from fic_jax.engine import arithmetic, sweeping
from fic_jax.engine.xla import BLOCKS, LANES
from fic_jax.lanes import Untranslatable
from fic_jax.lanes.graph import Branch, Loop, live
from fic_jax.params import QUANTITIES
from tests.engine.scenarios import DT, assert_same, pick, random_batch
from tests.lanes.compiling import compiled_graph, loop_of

# every option at least once
MODELS = [
    Model(),
    Model("effort", "error_rate", "running", "error", "motor", "damped_rebound", "rk4_events"),
    Model("energy", "velocity_band", contact="welded", integrator="rk4_events"),
    Model("algorithm1", "error_rate", "running", "error"),
]


@pytest.fixture
def compiled_anew():
    """The test patches the compiler: compile for it, and drop the programs afterwards."""
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    sweeping._program.cache_clear()
    yield sweeping._program.cache_clear
    sweeping._program.cache_clear()
    jax.config.update("jax_compilation_cache_dir", folder)


@pytest.mark.parametrize("backend", ["lanes", "xla"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scenario_alone_equals_its_lane_among_many(backend, dtype):
    """The same bits for any neighbours, place, number of scenarios and number of calls."""
    n = 2 * BLOCKS["xla"] * LANES + 77  # more than one call of the program, with a ragged end
    batch = random_batch(n, dtype=dtype)
    whole = sweep(batch, dt=DT, n_steps=60, backend=backend)
    assert whole.nmse.dtype == dtype
    for index in (0, 1, LANES, n // 2, n - 1):
        alone = sweep(pick(batch, slice(index, index + 1)), dt=DT, n_steps=60, backend=backend)
        assert_same(alone, jax.tree.map(lambda a, i=index: a[i : i + 1], whole))
    order = np.random.default_rng(1).permutation(n)
    shuffled = sweep(pick(batch, order), dt=DT, n_steps=60, backend=backend)
    assert_same(shuffled, jax.tree.map(lambda a: a[order], whole))


@pytest.mark.parametrize(("lanes", "blocks"), [(32, 4), (64, 128), (256, 16)])
def test_any_block_size_gives_the_same_bits(lanes, blocks, monkeypatch, compiled_anew):
    batch, run = random_batch(700), {"dt": DT, "n_steps": 60, "backend": "xla"}
    expected = sweep(batch, **run)
    monkeypatch.setattr("fic_jax.engine.xla.LANES", lanes)
    monkeypatch.setitem(BLOCKS, "xla", blocks)
    compiled_anew()
    assert_same(sweep(batch, **run), expected)


@pytest.mark.parametrize("backend", ["lanes", "xla"])
def test_zero_scenarios_give_empty_metrics(backend):
    metrics = sweep(Params(K0=np.zeros(0)), dt=DT, n_steps=3, backend=backend)
    assert {leaf.shape for leaf in jax.tree.leaves(metrics)} == {(0,)}


WITH_A_FLAG = """
import os, sys, warnings
os.environ["XLA_FLAGS"] = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true"
import fic_jax
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    fic_jax.tune_for_throughput(1)
assert len(caught) == 1 and "XLA_FLAGS already has" in str(caught[0].message), caught
assert os.environ["XLA_FLAGS"].count("extra_options") == 1
"""


def test_xla_flags_that_are_set_stay_and_a_warning_names_them():
    subprocess.run([sys.executable, "-c", WITH_A_FLAG], check=True)


WITHOUT_FLAGS = """
import os, sys, warnings
import numpy as np
import fic_jax.engine.tuning
import jax
fic_jax.engine.tuning.TRIED_JAXLIB = ("0.0.",)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    fic_jax.tune_for_throughput(2)
assert len(caught) == 1 and "was not tried" in str(caught[0].message), caught
assert "xla_cpu_small_while_loop" not in os.environ.get("XLA_FLAGS", "")
K0 = np.geomspace(5.0, 500.0, 200).astype(np.float32)
metrics = fic_jax.sweep(fic_jax.Params(K0=K0), dt=0.01, n_steps=60, backend="xla")
assert len(jax.local_devices()) == 2
sys.stdout.write(metrics.nmse.tobytes().hex())
"""


def test_an_untried_jaxlib_runs_without_the_flags():
    """One warning, both devices, and the numbers of the vector kernel to a few ulp."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    command = [sys.executable, "-c", WITHOUT_FLAGS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    plain = np.frombuffer(bytes.fromhex(done.stdout), np.float32)
    K0 = np.geomspace(5.0, 500.0, 200).astype(np.float32)
    ours = sweep(Params(K0=K0), dt=np.float32(DT), n_steps=60).nmse
    assert ours.dtype == np.float32
    np.testing.assert_allclose(ours, plain, rtol=16 * np.finfo(np.float32).eps)


@pytest.mark.parametrize("backend", ["lanes", "xla"])
def test_one_device_equals_two(backend, monkeypatch):
    batch = random_batch(1000)
    both = sweep(batch, dt=DT, n_steps=60, backend=backend)
    assert jax.local_device_count() == 2
    one = jax.local_devices()[:1]
    monkeypatch.setattr(jax, "local_devices", lambda: one)
    assert_same(sweep(batch, dt=DT, n_steps=60, backend=backend), both)


def test_sweep_equals_evaluate():
    """Two programs of one function round differently; 200 steps leave below 1e-9."""
    batch = random_batch(16)
    swept = sweep(batch, dt=DT, n_steps=200)
    for i in range(16):
        single = evaluate(pick(batch, i), dt=DT, n_steps=200)
        for name in METRICS:
            np.testing.assert_allclose(
                getattr(swept, name)[i], getattr(single, name), rtol=1e-9, atol=1e-12
            )


def test_a_diverged_scenario_is_not_finite_and_does_not_change_its_neighbours():
    """On a weld too stiff for dt, RK4 is unstable: `finite` is false."""
    batch, model = Params(Kenv=np.array([100.0, 1e9, 500.0])), Model(contact="welded")
    metrics = sweep(batch, model=model, dt=DT, n_steps=200)
    np.testing.assert_array_equal(metrics.finite, [True, False, True])
    alone = sweep(pick(batch, slice(0, 1)), model=model, dt=DT, n_steps=200)
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
def test_wrong_parameters_are_refused(bad, message):
    columns = {name: np.asarray(value, float) for name, value in bad.items()}
    with pytest.raises(ParamsError, match=message):
        sweep(Params(**columns), dt=DT, n_steps=5)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_lanes_agree_with_xla_to_rounding(model):
    """Both follow the same traced function; 60 steps are too few for a rounding to grow."""
    scenarios = replace(random_batch(300, seed=1), Kenv=np.full(300, 200.0), v_init=0.3)
    estimate, results = model == MODELS[-1], []  # the estimate takes XLA long
    for backend in ("lanes", "xla"):
        metrics = sweep(
            scenarios, model=model, dt=DT, n_steps=60, error_estimate=estimate, backend=backend
        )
        results.append(metrics if estimate else (metrics,))
    for mine, theirs in zip(*results, strict=True):
        for name in METRICS:
            got, expected = getattr(mine, name), getattr(theirs, name)
            assert got.dtype == expected.dtype
            # in about one scenario of a hundred rounding decides on which side of a switch it is
            close = np.isclose(got, expected, rtol=1e-7, atol=1e-9, equal_nan=True)
            assert np.mean(close) > 0.98, name


def test_the_peak_of_no_torque_is_plus_zero():
    nothing = Params(Kenv=np.zeros(3), Denv=0.0, Td=-1.0)
    peak = sweep(nothing, model=Model(contact="welded"), dt=DT, n_steps=20).peak_torque
    assert not peak.any()
    assert not np.signbit(peak).any()


def compiled_scenario(model, n_steps=50):
    """The live nodes of a scenario after the compiler's passes."""
    one = sweeping.scenario(model, n_steps, False)
    roots = compiled_graph(
        lambda *args: one(args[:-1], args[-1]), len(QUANTITIES) + 1, np.dtype(np.float32)
    )
    return live(roots)


def test_the_default_law_computes_exponentials_in_branches_only():
    """Slopes, the bend in each of RK4's four stages, the start of the tail, the band's entry."""
    nodes = compiled_scenario(Model())
    loop = loop_of(nodes)
    branches = {n.of for n in nodes if isinstance(n.of, Branch) and n.of.outer is loop}
    assert len(branches) == 7
    assert not [n for n in nodes if n.op in ("exp", "div") and n.scope is loop]


def test_located_switches_compute_exponentials_and_roots_in_branches_only():
    """In both loops: that of fixed length, and that of the scenarios that are not finished."""
    nodes = compiled_scenario(Model(integrator="rk4_events"))
    loops = {n.of for n in nodes if isinstance(n.of, Loop)}
    assert len(loops) == 2
    assert not [n for n in nodes if n.op in ("exp", "sqrt") and n.scope in loops]


@pytest.mark.parametrize("error", [Untranslatable("the operation sin"), ImportError("llvmlite")])
def test_without_the_lane_compiler_xla_runs_and_one_warning_says_so(
    error, monkeypatch, compiled_anew
):
    batch, run = random_batch(10, dtype=np.float32), {"dt": DT, "n_steps": 20}
    expected = sweep(batch, backend="xla", **run)

    def fail(*_, **__):
        raise error

    monkeypatch.setattr("fic_jax.lanes.mapping.LaneMap._kernel", fail)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        results = [sweep(batch, **run) for _ in range(2)]
    (message,) = [str(w.message) for w in caught]
    assert message.startswith(f"lanes ({type(error).__name__}: {error}) with jax")
    assert "XLA compiles the sweep instead" in message
    assert "pip install llvmlite" in message
    for metrics in results:
        assert_same(metrics, expected)
    with pytest.raises(type(error)):  # a backend chosen by name does not fall back
        sweep(batch, backend="lanes", **run)


def test_a_bug_of_the_lane_compiler_is_an_error(monkeypatch, compiled_anew):
    monkeypatch.setattr("fic_jax.lanes.kernel.this_processor", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        sweep(random_batch(10), dt=DT, n_steps=20)


def test_an_unknown_backend_is_refused():
    with pytest.raises(ParamsError, match="`backend` must be one of auto, lanes, ptx, xla, pallas"):
        sweep(Params(), dt=DT, n_steps=5, backend="cuda")


def test_arithmetic_names_the_backend_and_its_rounding(monkeypatch):
    assert arithmetic() == arithmetic("lanes")
    monkeypatch.setattr("fic_jax.lanes.objects.features", lambda: "+avx,-fma,")
    assert arithmetic("lanes") == "lanes unfused"
    monkeypatch.setattr("fic_jax.lanes.objects.features", lambda: "+avx,+fma,")
    assert arithmetic("lanes") == "lanes fused"
    assert arithmetic("xla") in ("xla fused", "xla unfused")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert arithmetic() == arithmetic("xla")
