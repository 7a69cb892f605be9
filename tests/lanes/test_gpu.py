"""Kernels on GPUs, without one: the host's side runs as it is, the PTX is interpreted."""

import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax import Model, sweep
from fic_jax.engine import sweeping
from fic_jax.lanes import gpu, lane_map
from fic_jax.lanes.objects import fused
from tests.engine.scenarios import DT, random_batch
from tests.lanes import card as cards
from tests.lanes.compiling import ODD, assert_same
from tests.lanes.programs import N_COLUMNS, program
from tests.lanes.test_instructions import NUMBERS, pairs
from tests.lanes.test_while import PROGRAMS as LOOPS
from tests.torture import many

H100, A100, T4 = (9, 0), (8, 0), (7, 5)
X = np.linspace(-1.0, 1.0, 40)
FLOATS = pytest.mark.parametrize("dtype", [np.float32, np.float64])


@pytest.fixture
def card(monkeypatch):
    return cards.install(monkeypatch, H100)


@pytest.fixture
def two_cards(monkeypatch):
    return cards.install(monkeypatch, H100, H100)


def assert_the_bits_of_the_cpu(function, *args, **options):
    """Of a CPU with fused multiply-adds; NaN is any NaN."""
    if not fused():
        pytest.skip("this processor has no fused multiply-add")
    assert_same(lane_map(function, gpus=[0], **options)(*args), lane_map(function)(*args))


def polynomial(x, y):
    return {"value": x * y + 0.5, "above": x > y, "whole": (4.0 * x).astype(jnp.int32)}


def columns(n, dtype):
    rng = np.random.default_rng(n)
    return rng.normal(size=n).astype(dtype), rng.normal(size=n).astype(dtype)


@FLOATS
@pytest.mark.parametrize("seed", range(many(8, 200)))
def test_programs_have_the_bits_of_the_cpu(seed, dtype, card):
    rng = np.random.default_rng(seed)
    args = rng.normal(scale=2.0, size=(N_COLUMNS, 12)).astype(dtype)
    args[rng.random(args.shape) < 0.2] = rng.choice(ODD)
    assert_the_bits_of_the_cpu(program(seed), *args, dtype(0.25))


@FLOATS
@pytest.mark.parametrize("name", LOOPS)
def test_loops_have_the_bits_of_the_cpu(name, dtype, card):
    x, y = np.linspace(0.5, 40.0, 9).astype(dtype), np.cos(np.arange(9)).astype(dtype)
    assert_the_bits_of_the_cpu(LOOPS[name], x, y)


@FLOATS
def test_operations_have_the_bits_of_the_cpu(dtype, card):
    """For every pair of special numbers, the sign of zero included."""
    assert_the_bits_of_the_cpu(lambda x, y: [f(x, y) for f in NUMBERS.values()], *pairs(dtype))


@FLOATS
def test_of_two_zeros_a_gpu_takes_the_one_that_the_cpu_takes(dtype, card):
    """PTX has min and max, but they order -0 before +0."""

    def zeros(x):
        least, most = jnp.minimum(x, 0.0), jnp.maximum(x, -0.0)
        return least, most, jnp.maximum(0.0, x), jnp.where(x < 0.0, x, 0.0), jnp.clip(x, 0.0, 1.0)

    assert_the_bits_of_the_cpu(zeros, np.array([0.0, -0.0, 1.0, -1.0, np.nan], dtype))


@FLOATS
def test_denormal_numbers_and_divisions_have_the_bits_of_the_cpu(dtype, card):
    tiny = np.finfo(dtype).smallest_normal
    x = np.array([tiny, -tiny / 3, tiny / 1024, 1.0, np.finfo(dtype).max], dtype)
    y = np.array([3.0, 0.75, 7.0, 1e-30, -0.1], dtype)
    assert_the_bits_of_the_cpu(
        lambda x, y: (x / y, 1.0 / y, x * y, x * y - x, jnp.sqrt(abs(x)), jnp.exp(-x)), x, y
    )


@FLOATS
def test_integers_and_bools(dtype, card):
    x, n, yes = (
        np.array([0.5, -1.5, 7e9], dtype),
        np.int32([3, -4, 5]),
        np.array([True, False, True]),
    )

    def mixed(x, n, yes, k):
        sums = x + n.astype(dtype), n * k.astype(jnp.int32), yes & (n > 0)
        return *sums, x.astype(jnp.int32), jnp.where(yes, n, -n), k

    assert_the_bits_of_the_cpu(mixed, x, n, yes, np.int64([7, -9, 2**30]))
    assert_the_bits_of_the_cpu(mixed, x, n, True, np.int64(7))


@pytest.mark.parametrize("n", [0, 1, 127, 128, 129])
def test_any_length(n, card):
    assert_the_bits_of_the_cpu(polynomial, *columns(n, np.float64))
    assert [grid for _, grid in card.launches] == ([-(-n // 128)] if n else [])


@pytest.mark.parametrize("y", [np.float32(0.5), np.broadcast_to(np.float32(0.5), 500)])
def test_a_number_for_all_lanes_is_copied_once(y, monkeypatch, card):
    sizes, copy_from = [], cards.Buffer.copy_from

    def recorded(self, src, *, stream):
        sizes.append(self.size)
        copy_from(self, src, stream=stream)

    monkeypatch.setattr(cards.Buffer, "copy_from", recorded)
    assert_the_bits_of_the_cpu(lambda x, y: x * y, np.linspace(0.0, 1.0, 500, dtype=np.float32), y)
    assert sizes == [2048 + 4, 2000]  # a column, aligned, and a number; the results


def test_scalars_alone_give_scalars(card):
    assert lane_map(lambda x, y: x * y + 0.25, gpus=[0])(0.5, 3.0) == 1.75


@pytest.mark.parametrize("gpus", [[0], [0, 1]])
def test_parts_threads_and_gpus_change_no_bit(gpus, monkeypatch, two_cards):
    x, y = columns(150, np.float64)
    expected = lane_map(polynomial, gpus=[0])(x, y)
    monkeypatch.setattr("fic_jax.lanes.gpu.LEAST", 16)
    monkeypatch.setattr("fic_jax.lanes.gpu.MOST", 32)
    two_cards.launches.clear()
    assert_same(lane_map(polynomial, gpus=gpus, threads=3)(x, y), expected)
    assert len(two_cards.launches) == 5
    assert {gpu for gpu, _ in two_cards.launches} == set(gpus)


def test_likeness_changes_no_bit(card):
    assert_the_bits_of_the_cpu(
        polynomial, *columns(20, np.float64), likeness=lambda x, y: np.argsort(x)
    )


def test_memory_of_the_gpu_is_used_again(card):
    mapped = lane_map(polynomial, gpus=[0], threads=1)
    for n in (10, 3, 10):
        mapped(*columns(n, np.float64))
    assert len(card.memory[0]) == 1
    mapped(*columns(200, np.float64))
    assert len(card.memory[0]) == 2


@pytest.mark.parametrize("place", ["Device.allocate", "Stream.sync", "launch"])
def test_an_error_of_the_gpu_reaches_the_caller_and_the_next_call_runs(place, monkeypatch, card):
    x, y = columns(4, np.float64)
    mapped = lane_map(polynomial, gpus=[0])
    mapped.prepare(x, y)

    def fail(*_, **__):
        raise MemoryError("out of memory on the GPU")

    with monkeypatch.context() as patched:
        if place == "launch":
            patched.setattr(sys.modules["cuda.core"], "launch", fail)
        else:
            patched.setattr(f"tests.lanes.card.{place}", fail)
        with pytest.raises(MemoryError, match="on the GPU"):
            mapped(x, y)
    assert_same(mapped(x, y), lane_map(polynomial, gpus=[0])(x, y))


def test_results_are_not_overwritten_while_they_live_and_their_memory_is_used_again(card):
    mapped = lane_map(polynomial, gpus=[0])
    x, y = columns(50, np.float64)
    first = mapped(x, y)
    kept = [leaf.copy() for leaf in jax.tree.leaves(first)]
    mapped(y, x)
    for leaf, before in zip(jax.tree.leaves(first), kept, strict=True):
        np.testing.assert_array_equal(leaf, before)
    del first, leaf
    locked = card.locked
    for n in range(40, 50):
        mapped(x[:n], y[:n])
    assert card.locked == locked


def test_unused_memory_is_bounded(monkeypatch, card):
    monkeypatch.setattr("fic_jax.lanes.gpu.UNUSED", 10_000)
    mapped = lane_map(lambda x: x + 1.0, gpus=[0])
    for n in (1000, 10, 3000, 100, 1000):
        mapped(np.ones(n))
    mapped(np.ones(1))
    assert sum(buffer.size for buffer in gpu._unused) <= 10_000 + 256


def test_without_page_locked_memory_results_are_ordinary_arrays(monkeypatch, card):
    mapped = lane_map(polynomial, gpus=[0])
    mapped.prepare(*columns(4, np.float64))

    def refuse(*_, **__):
        raise MemoryError("no more page-locked memory")

    with monkeypatch.context() as patched:
        patched.setattr("fic_jax.lanes.gpu.page_locked", refuse)
        (kernel, _), *_ = mapped._compiled.values()
        assert all(out.base is None for out in kernel.empty(4))


@pytest.mark.parametrize("few_first", [True, False])
def test_memory_on_either_side_grows(few_first, card):
    """One function has many columns and one result, the other one column and many results."""
    wide = lane_map(lambda *xs: 10.0 * xs[-1], gpus=[0])
    tall = lane_map(lambda x: tuple(x * k for k in range(2, 12)), gpus=[0])
    calls = [lambda: wide(*10 * [X]), lambda: tall(X)]
    for call in calls if few_first else reversed(calls):
        call()
    np.testing.assert_array_equal(wide(*10 * [X]), 10.0 * X)
    for k, leaf in enumerate(tall(X), 2):
        np.testing.assert_array_equal(leaf, k * X)


def test_an_error_leaves_no_copy_under_way(monkeypatch, card):
    mapped = lane_map(lambda x: (x + 0.5, x + 1.0, x + 2.0), gpus=[0], threads=1)
    mapped.prepare(X)
    copy, count = cards.Buffer.copy_from, []

    def third_fails(self, src, *, stream):
        count.append(1)
        if len(count) == 4:  # the column, two results, then
            raise MemoryError("a copy failed")
        copy(self, src, stream=stream)

    with monkeypatch.context() as patched:
        patched.setattr(cards.Buffer, "copy_from", third_fails)
        patched.setattr(cards.Stream, "sync", _recorded(cards.Stream.sync, synced := []))
        with pytest.raises(MemoryError, match="a copy failed"):
            mapped(X)
    assert synced and not synced[-1].waiting


def _recorded(sync, streams):
    def recorded(self):
        sync(self)
        streams.append(self)

    return recorded


def test_the_callers_current_gpu_stays_what_it_is(two_cards):
    card = two_cards
    card.current.gpu = 1
    mapped = lane_map(polynomial, gpus=[0])
    mapped(*columns(4, np.float64))
    assert card.current.gpu == 1


def test_code_is_for_the_oldest_gpu(monkeypatch):
    card = cards.install(monkeypatch, H100, T4)
    lane_map(polynomial, gpus=[0, 1])(*columns(3, np.float32))
    lane_map(polynomial, gpus=[0])(*columns(3, np.float32))
    assert [p.target for p in card.programs] == ["sm_75", "sm_90"]


def test_newer_gpus_take_code_of_one_that_llvm_knows(monkeypatch):
    card = cards.install(monkeypatch, (13, 7))
    assert_the_bits_of_the_cpu(polynomial, *columns(3, np.float32))
    assert [p.target for p in card.programs] == ["sm_90"]


@pytest.fixture
def a_stream_of_jax(monkeypatch, card):
    """Callbacks inside jit get buffers on the GPU, and a stream by its handle."""
    device = sys.modules["cuda.core"].Device(0)
    device.set_current()
    stream = device.create_stream()
    monkeypatch.setitem(cards.Stream.handles, 77, stream)

    def on_device(array):
        card.memory[0][array.ctypes.data] = array.reshape(-1).view(np.uint8)
        interface = {"data": (array.ctypes.data, False)}
        return SimpleNamespace(__cuda_array_interface__=interface)

    def buffer_callback(call, types):
        def on_host(*columns):
            outs = [np.zeros(t.shape, t.dtype) for t in types]
            held = [np.array(column) for column in columns]
            call(SimpleNamespace(stream=77), [*map(on_device, outs)], *map(on_device, held))
            assert not any(np.any(out) for out in outs)  # the kernel waits in the stream
            stream.sync()
            return outs

        return lambda *columns: jax.pure_callback(on_host, types, *columns)

    monkeypatch.setattr("fic_jax.lanes.mapping.buffer_callback", buffer_callback)


@FLOATS
@pytest.mark.parametrize("n", [0, 1, 130])
def test_inside_jit_a_kernel_takes_jaxs_buffers_and_stream(n, dtype, card, a_stream_of_jax):
    """It copies nothing: it gets their addresses."""
    x, y = columns(n, dtype)
    mapped = lane_map(polynomial, gpus=[0])
    inside = jax.jit(lambda x, y: mapped.inside_jit(2.0 * x, y))
    for other in (y, dtype(0.25)):
        assert_same(jax.tree.map(np.asarray, inside(x, other)), mapped(dtype(2.0) * x, other))
    alone = jax.jit(mapped.inside_jit)(dtype(0.5), dtype(0.25))
    assert alone["value"].shape == ()
    assert alone["value"] == 0.625


class OnGPU:
    """A device of JAX."""

    platform, device_kind, local_hardware_id = "gpu", "H100", 0


def test_a_sweep_inside_jit_has_the_bits_of_one_outside(
    card, a_stream_of_jax, compiled_anew, monkeypatch
):
    device = OnGPU()
    monkeypatch.setattr(jax, "local_devices", lambda: (device,))
    batch, options = random_batch(5, dtype=np.float32), {"dt": DT, "n_steps": 20, "backend": "ptx"}
    inside = jax.jit(lambda batch: sweep(batch, **options))(batch)
    assert_same(jax.tree.map(np.asarray, inside), sweep(batch, **options))


@FLOATS
@pytest.mark.parametrize(
    "model",
    [Model(), Model(integrator="rk4_events"), Model("effort")],
    ids=["rk4", "located", "effort"],
)
def test_a_sweep_has_the_bits_of_the_cpu(model, dtype, card, compiled_anew):
    """One of five scenarios diverges to NaN."""
    batch = random_batch(5, dtype=dtype)
    batch.Kenv[2] = 1e9
    assert_the_bits_of_a_sweep_on_the_cpu(batch, model=model)
    assert [grid for _, grid in card.launches] == [1]


def test_a_sweep_on_two_gpus_with_error_estimates(two_cards, monkeypatch, compiled_anew):
    monkeypatch.setattr("fic_jax.lanes.gpu.LEAST", 2)
    monkeypatch.setattr("fic_jax.lanes.gpu.MOST", 2)
    batch = random_batch(5, dtype=np.float32)
    assert_the_bits_of_a_sweep_on_the_cpu(batch, error_estimate=True)
    assert sorted(gpu for gpu, _ in two_cards.launches) in ([0, 0, 1], [0, 1, 1])


@pytest.fixture
def compiled_anew():
    sweeping._program.cache_clear()
    yield
    sweeping._program.cache_clear()


def assert_the_bits_of_a_sweep_on_the_cpu(batch, **options):
    if not fused():
        pytest.skip("this processor has no fused multiply-add")
    got, expected = (
        sweep(batch, dt=DT, n_steps=20, backend=backend, **options) for backend in ("ptx", "lanes")
    )
    assert_same(got, expected)
