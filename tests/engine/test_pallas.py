"""The backend `pallas` without a GPU: interpreted, it gives XLA's bits; its GPU code is lowered."""

import warnings
from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax import Model, Params, sweep
from fic_jax.engine import sweeping
from fic_jax.engine.pallas import in_one_kernel
from fic_jax.engine.xla import LANES, in_blocks
from fic_jax.params import QUANTITIES

RNG = np.random.default_rng(7)
N = 2 * 4 * LANES + 77  # two devices, more than one call, a ragged end
BATCH = {
    "K0": np.geomspace(1.0, 300.0, N),
    "Kenv": RNG.uniform(50.0, 500.0, N),
    "Td": RNG.uniform(1.0, 20.0, N),
    "gap": RNG.choice([0.0, 0.01], N),
    "period": RNG.choice([0.01, 0.02], N),
}
# every option at least once
MODELS = [
    Model(),
    Model("effort", "error_rate", "running", "error", "motor", "damped_rebound", "rk4_events"),
    Model("energy", "velocity_band", contact="welded", integrator="rk4_events"),
]


@pytest.mark.parametrize(
    ("model", "dtype"), list(zip(MODELS, (np.float32, np.float64, np.float32), strict=True))
)
def test_the_kernel_gives_the_bits_of_xla(model, dtype):
    """Of the same loops: with located switches `sweep` has others for XLA."""
    batch = Params(**{name: values.astype(dtype) for name, values in BATCH.items()})
    kernel = sweep(batch, model=model, dt=0.01, n_steps=30, backend="pallas")
    scanned = in_blocks(
        "xla",
        sweeping.scenario(model, 30, False, by_steps=True),
        len(QUANTITIES),
        sweeping.result_types(model, False, np.dtype(dtype)),
        np.dtype(dtype),
        jax.local_devices(),
    )([np.broadcast_to(np.asarray(leaf, dtype), N) for leaf in vars(batch).values()], dtype(0.01))
    for one, other in zip(*map(jax.tree.leaves, (scanned, kernel)), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.law)
def test_the_whole_run_is_one_triton_call(model, dtype):
    """Lowered for a GPU without one; with its estimate, two time loops in one kernel."""
    launch = in_one_kernel(
        sweeping.scenario(model, 1000, True, by_steps=True),
        sweeping.result_types(model, True, np.dtype(dtype)),
        lanes=LANES,
        interpret=False,
    )
    columns = jax.ShapeDtypeStruct((len(QUANTITIES), 8, LANES), dtype)
    dt, blocks = jax.ShapeDtypeStruct((), dtype), jax.ShapeDtypeStruct((), np.int32)
    with _a_gpu(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The Pallas Triton backend", DeprecationWarning)
        lowered = jax.jit(launch).trace(columns, dt, blocks).lower(lowering_platforms=("cuda",))
    text = lowered.as_text()
    assert text.count("__gpu$xla.gpu.triton") == 1
    assert "stablehlo.while" not in text


def _a_gpu():
    """From jax 0.11 on, lowering needs the name of a GPU."""
    from jax.sharding import AbstractMesh

    try:
        from jax.sharding import AbstractDevice
    except ImportError:
        return nullcontext()
    device = AbstractDevice(device_kind="NVIDIA H100 80GB HBM3", num_cores=132, platform="gpu")
    return jax.sharding.use_abstract_mesh(AbstractMesh((), (), abstract_device=device))


def test_where_the_kernel_cannot_be_built_xla_runs_and_one_warning_says_so(monkeypatch):
    batch, run = Params(K0=np.float32([10.0, 100.0])), {"dt": 0.01, "n_steps": 20}
    expected = sweep(batch, backend="xla", **run)
    monkeypatch.setitem(sweeping.FASTEST, "cpu", ("pallas", "xla"))
    monkeypatch.setattr("fic_jax.engine.pallas.in_one_kernel", lambda *_, **__: 1 / 0)
    sweeping._program.cache_clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        results = [sweep(batch, **run) for _ in range(2)]
    sweeping._program.cache_clear()
    (message,) = [str(w.message) for w in caught]
    assert message.startswith("pallas (ZeroDivisionError: division by zero) with jax")
    for metrics in results:
        np.testing.assert_array_equal(metrics.nmse, expected.nmse)


def test_only_the_given_number_of_blocks_is_computed():
    launch = in_one_kernel(
        lambda columns, dt: columns[0] + dt,
        jax.ShapeDtypeStruct((), np.float32),
        lanes=LANES,
        interpret=True,
    )
    results = launch(jnp.ones((1, 3, LANES), np.float32), jnp.float32(0.5), jnp.int32(2))
    np.testing.assert_array_equal(results[:2], 1.5)
    assert not np.any(results[2] == 1.5)
