"""The GPU's arrangement where there is no GPU: its numbers interpreted, its code only lowered.

What a GPU makes of that code is for a machine that has one.
"""

import warnings
from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax import Model, Params, engine, sweep
from fic_jax.engine.pallas import in_one_kernel
from fic_jax.engine.xla import LANES
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
    Model("effort", "error_rate", "running", "motor", "damped_rebound", "rk4_events"),
    Model("energy", "velocity_band", "latched", "interaction", "welded", "rk4_events"),
]


@pytest.mark.parametrize(
    ("model", "dtype"), list(zip(MODELS, (np.float32, np.float64, np.float32), strict=True))
)
def test_the_kernel_gives_the_bits_of_the_scan(arranged, model, dtype):
    batch = Params(**{name: values.astype(dtype) for name, values in BATCH.items()})
    found = []
    for arrangement in ("scan", "interpreted"):
        arranged(arrangement)
        found.append(sweep(batch, model=model, dt=0.01, n_steps=30))
    for scanned, kernel in zip(*map(jax.tree.leaves, found), strict=True):
        assert scanned.dtype == kernel.dtype
        np.testing.assert_array_equal(scanned, kernel)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.law)
def test_the_whole_run_is_one_triton_call(model, dtype):
    """Lowered for a GPU without one; with its estimate, two time loops in one kernel."""
    launch = in_one_kernel(
        engine._scenario(model, 1000, True, unroll=1),
        engine._result(model, True, np.dtype(dtype)),
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
    """From jax 0.11 on, lowering asks what GPU it is for."""
    from jax.sharding import AbstractMesh

    try:
        from jax.sharding import AbstractDevice
    except ImportError:
        return nullcontext()
    device = AbstractDevice(device_kind="NVIDIA H100 80GB HBM3", num_cores=132, platform="gpu")
    return jax.sharding.use_abstract_mesh(AbstractMesh((), (), abstract_device=device))


def test_where_the_kernel_cannot_be_built_the_scan_runs_and_one_warning_says_so(arranged):
    batch = Params(K0=np.float32([10.0, 100.0]))
    arranged("scan")
    expected = sweep(batch, dt=0.01, n_steps=20)
    arranged("kernel")  # on a CPU Pallas only interprets
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = [sweep(batch, dt=0.01, n_steps=20) for _ in range(2)]
    assert [str(w.message)[:13] for w in told] == ["no GPU kernel"]
    assert "cpu (ValueError: Only interpret mode" in str(told[0].message)
    for metrics in found:
        np.testing.assert_array_equal(metrics.nmse, expected.nmse)


def test_only_the_blocks_asked_for_are_computed():
    launch = in_one_kernel(
        lambda columns, dt: columns[0] + dt,
        jax.ShapeDtypeStruct((), np.float32),
        lanes=LANES,
        interpret=True,
    )
    found = launch(jnp.ones((1, 3, LANES), np.float32), jnp.float32(0.5), jnp.int32(2))
    np.testing.assert_array_equal(found[:2], 1.5)
    assert not np.any(found[2] == 1.5)
