"""The backend `ptx` without a GPU: sweeps inside `jax.jit`, and what `auto` tries on a GPU."""

import sys
import warnings

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import numpy as np
import pytest

from fic_jax import Model, Params, ParamsError, sweep
from fic_jax.engine import sweeping
from tests.engine.scenarios import DT, assert_same, pick, random_batch
from tests.lanes import card as cards

RUN = {"dt": DT, "n_steps": 20}
N = 37


@pytest.fixture
def compiled_anew():
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    sweeping._program.cache_clear()
    yield
    sweeping._program.cache_clear()
    jax.config.update("jax_compilation_cache_dir", folder)


# ---- Inside jit, with the CPU's kernels ----------------------------------------------------------


def on_host(metrics):
    return jax.tree.map(np.asarray, metrics)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("model", [Model(), Model(integrator="rk4_events")], ids=["rk4", "located"])
def test_a_sweep_inside_jit_has_the_bits_of_one_outside(model, dtype):
    batch = random_batch(N, dtype=dtype)
    inside = jax.jit(lambda batch: sweep(batch, model=model, **RUN))(batch)
    assert isinstance(inside.nmse, jax.Array)
    assert inside.nmse.dtype == dtype
    assert_same(on_host(inside), sweep(batch, model=model, **RUN))


def test_the_step_may_be_traced_and_errors_estimated():
    batch = random_batch(N)
    estimated = {"error_estimate": True, "n_steps": 20}
    inside = jax.jit(lambda batch, dt: sweep(batch, dt=dt, **estimated))(batch, DT)
    for one, other in zip(inside, sweep(batch, dt=DT, **estimated), strict=True):
        assert_same(on_host(one), other)


def test_numbers_for_all_scenarios_and_one_scenario_alone():
    Kenv = np.linspace(50.0, 500.0, N)
    batch = Params(K0=40.0, Kenv=Kenv, Td=np.full(1, 5.0))
    inside = jax.jit(lambda K0, Td: sweep(Params(K0=K0, Kenv=Kenv, Td=Td), **RUN))
    assert_same(on_host(inside(40.0, np.full(1, 5.0))), sweep(batch, **RUN))
    alone = jax.jit(lambda K0: sweep(Params(K0=K0, Kenv=200.0), **RUN))(40.0)
    assert alone.nmse.shape == (1,)
    assert_same(on_host(alone), sweep(Params(K0=40.0, Kenv=200.0), **RUN))


def test_a_batch_made_and_reduced_inside_jit_is_that_of_the_host():
    @jax.jit
    def worst(least, most):
        metrics = sweep(Params(K0=jnp.linspace(least, most, N), Kenv=200.0), **RUN)
        return jnp.max(metrics.nmse), jnp.argmax(metrics.nmse), jnp.sum(metrics.finite)

    K0 = np.asarray(jax.jit(lambda a, b: jnp.linspace(a, b, N))(5.0, 300.0))
    nmse = sweep(Params(K0=K0, Kenv=200.0), **RUN).nmse
    most, index, finite = worst(5.0, 300.0)
    assert (most, index, finite) == (nmse.max(), nmse.argmax(), N)


def test_a_second_call_compiles_nothing(compiled_anew):
    traces = []

    @jax.jit
    def inside(batch):
        traces.append(1)
        return sweep(batch, **RUN).nmse

    one, other = random_batch(N, seed=1), random_batch(N, seed=2)
    np.testing.assert_array_equal(inside(one), sweep(one, **RUN).nmse)
    np.testing.assert_array_equal(inside(other), sweep(other, **RUN).nmse)
    assert len(traces) == 1
    assert sweeping._program.cache_info().currsize <= 2  # traced, and outside


@pytest.mark.parametrize("transform", [jax.vmap, lambda f: jax.vmap(jax.jit(f), axis_size=2)])
def test_other_transformations_of_a_sweep_are_refused(transform):
    with pytest.raises((ParamsError, NotImplementedError), match="vmap"):
        transform(lambda K0: sweep(Params(K0=K0), **RUN))(np.array([10.0, 20.0]))


def test_gradients_of_a_sweep_are_refused():
    with pytest.raises(ParamsError, match="known outside of jit, vmap and grad"):
        jax.grad(lambda K0: sweep(Params(K0=K0), **RUN).nmse[0])(10.0)


@pytest.mark.parametrize("backend", ["xla", "pallas", "ptx"])
def test_other_backends_are_refused_inside_jit(backend):
    why = f"must be lanes where the batch is traced .* a cpu, but is {backend}"
    with pytest.raises(ParamsError, match=why):
        jax.jit(lambda K0: sweep(Params(K0=K0), backend=backend, **RUN))(10.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"n_steps": 0}, "`n_steps`"),
        ({"model": "default"}, "`model`"),
        ({"backend": "cuda"}, "`backend` must be one of"),
        ({"dt": -0.01}, "`dt` must be positive"),
        ({"dt": "0.01"}, "`dt` must be a positive number"),
    ],
)
def test_what_is_known_while_tracing_is_checked(wrong, message):
    with pytest.raises(ParamsError, match=message):
        jax.jit(lambda K0: sweep(Params(K0=K0), **{**RUN, **wrong}))(10.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"Fmax": -1.0}, "`Fmax` must be positive"),
        ({"Kenv": np.array([1.0, np.nan])}, "`Kenv`"),
        ({"period": 0.0153}, "`period` must be a whole multiple"),
        ({"xb": 0.05}, "`xb` must be greater"),
    ],
)
def test_values_known_while_others_are_traced_are_checked(wrong, message):
    with pytest.raises(ParamsError, match=message):
        jax.jit(lambda K0: sweep(Params(K0=K0, **wrong), **RUN))(10.0)


def test_leaves_of_different_lengths_are_refused_while_tracing():
    with pytest.raises(ParamsError, match="`batch` must be scalars and"):
        jax.jit(lambda K0, Td: sweep(Params(K0=K0, Td=Td), **RUN))(np.ones(2), np.ones(3))


# ---- What `auto` tries on a GPU ------------------------------------------------------------------


class OnGPU:
    """A device of JAX on a CPU that says it is a GPU, to the choice of backends only."""

    platform, device_kind, local_hardware_id = "gpu", "H100", 0


@pytest.fixture
def a_gpu(monkeypatch, compiled_anew):
    """JAX sees a GPU; XLA and Pallas still compile for the CPU, the latter interpreted."""
    device, by_jax = (OnGPU(),), sweeping._by_jax
    monkeypatch.setattr(jax, "local_devices", lambda: device)
    cpus = tuple(jax.devices("cpu"))
    monkeypatch.setattr(sweeping, "_by_jax", lambda *args: by_jax(*args[:-1], cpus))


def without_cuda_core(monkeypatch):
    monkeypatch.setitem(sys.modules, "cuda.core", None)


def with_an_old_driver(monkeypatch):
    cards.install(monkeypatch, (9, 0))

    def from_ptx(_):
        raise RuntimeError("CUDA_ERROR_UNSUPPORTED_PTX_VERSION")

    monkeypatch.setattr(sys.modules["cuda.core"].ObjectCode, "from_ptx", from_ptx)


def without_a_driver(monkeypatch):
    cards.install(monkeypatch, (9, 0), driver=RuntimeError("libcuda.so.1 was not found"))


def without_nvptx(monkeypatch):
    cards.install(monkeypatch, (9, 0))

    def from_triple(_):
        raise RuntimeError("No available targets are compatible with triple nvptx64-nvidia-cuda")

    monkeypatch.setattr(llvm.Target, "from_triple", from_triple)


WAYS = [
    (without_cuda_core, ImportError, "cuda.core"),
    (with_an_old_driver, RuntimeError, "UNSUPPORTED_PTX_VERSION"),
    (without_a_driver, RuntimeError, "libcuda"),
    (without_nvptx, RuntimeError, "nvptx64"),
]


@pytest.mark.parametrize(("fails", "error", "why"), WAYS, ids=lambda w: getattr(w, "__name__", ""))
def test_where_ptx_fails_pallas_runs_and_one_warning_says_so(fails, error, why, monkeypatch, a_gpu):
    batch = random_batch(5, dtype=np.float32)
    expected = sweep(batch, backend="pallas", **RUN)
    fails(monkeypatch)
    (message,) = messages_of_two(batch, expected)
    assert message.startswith("ptx (")
    assert why in message
    assert "on H100 failed: Pallas compiles the sweep instead" in message
    assert "pip install 'fic-jax[gpu]'" in message
    with pytest.raises(error, match=why):  # a backend chosen by name does not fall back
        sweep(batch, backend="ptx", **RUN)


def test_where_pallas_fails_too_xla_runs_and_the_warning_names_both(monkeypatch, a_gpu):
    batch = random_batch(5, dtype=np.float32)
    expected = sweep(batch, backend="xla", **RUN)
    without_cuda_core(monkeypatch)
    monkeypatch.setattr("fic_jax.engine.pallas.in_one_kernel", lambda *_, **__: 1 / 0)
    (message,) = messages_of_two(batch, expected)
    for words in ("ptx (", "and pallas (ZeroDivisionError", "XLA launches several kernels"):
        assert words in message


def messages_of_two(batch, expected):
    """The warnings of two sweeps on `auto`, which have these metrics."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        results = [sweep(batch, **RUN) for _ in range(2)]
    for metrics in results:
        assert_same(metrics, expected)
    assert {w.category for w in caught} == {RuntimeWarning}
    return [str(w.message) for w in caught]


def test_on_a_gpu_auto_is_ptx_and_warns_of_nothing(monkeypatch, a_gpu):
    card = cards.install(monkeypatch, (9, 0))
    batch = random_batch(5, dtype=np.float32)
    metrics = sweep(batch, **RUN)
    assert card.launches == [(0, 1)]
    assert_same(metrics, sweep(batch, backend="ptx", **RUN))
    assert_same(sweep(pick(batch, slice(1, 2)), **RUN), pick_metrics(metrics, slice(1, 2)))


def pick_metrics(metrics, index):
    return jax.tree.map(lambda leaf: leaf[index], metrics)


def test_where_jax_has_no_gpu_ptx_takes_those_of_the_driver(monkeypatch, compiled_anew):
    card = cards.install(monkeypatch, (9, 0), (9, 0))
    monkeypatch.setattr("fic_jax.lanes.gpu.LEAST", 1)
    monkeypatch.setattr("fic_jax.lanes.gpu.MOST", 1)
    sweep(random_batch(4, dtype=np.float32), backend="ptx", **RUN)
    assert sorted(gpu for gpu, _ in card.launches) == [0, 0, 1, 1]


@pytest.mark.parametrize(("fails", "error", "why"), WAYS, ids=lambda w: getattr(w, "__name__", ""))
def test_ptx_by_name_on_a_cpu_raises_what_is_missing(fails, error, why, monkeypatch, compiled_anew):
    fails(monkeypatch)
    with pytest.raises(error, match=why):
        sweep(Params(), backend="ptx", **RUN)


def test_the_arithmetic_of_ptx_is_that_of_fused_lanes():
    assert sweeping.arithmetic("ptx") == "lanes fused"


def test_the_arithmetic_of_auto_on_a_gpu_is_that_of_the_first_way_that_works(monkeypatch):
    monkeypatch.setattr(jax, "local_devices", lambda: (OnGPU(),))
    for fails in (without_cuda_core, with_an_old_driver, without_a_driver, without_nvptx):
        with monkeypatch.context() as patched:
            fails(patched)
            assert sweeping.arithmetic().startswith("pallas "), fails
    cards.install(monkeypatch, (9, 0))
    assert sweeping.arithmetic() == "lanes fused"
