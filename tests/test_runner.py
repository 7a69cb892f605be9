"""A run: the same bits whatever the blocks, interruptions and failures; and what it refuses."""

import re

import jax
import numpy as np
import pytest
import xarray as xr

import fic_jax
from sweeps import compile_cache, provenance, runner
from sweeps.cli import messages
from sweeps.plan.grid import Grid, cells_of
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import format as store_format
from sweeps.store import ledger
from sweeps.store.lock import locked
from sweeps.store.opening import Counts, dataset, open_store
from tests.store.stores import change_attributes

TEXT = """
name = "tiny"
description = "two contacts, two axes, two cases"
[time]
t_end = 0.5
[model]
contact = ["welded", "hard_stop"]
[axes]
K0 = { log = [1.0, 300.0], n = 5 }
Td = [1.0, 5.0, 20.0]
[cases]
Denv = [0.0, 63.2]
gap = [0.0, 0.1]
"""
PLAN = parse(TEXT, "tiny.toml")
ESTIMATED = """
name = "estimated"
description = "easy, hard and unstable cells"
error_estimate = true
[time]
t_end = 0.2
[model]
contact = "welded"
[axes]
K0 = { log = [1.0, 300.0], n = 5 }
Kenv = [100.0, 3000.0, 1e9]
[cases]
Denv = [0.0, 63.2]
"""
DOUBTED = parse(ESTIMATED, "estimated.toml")


def quiet(progress):
    pass


def complete(path, plan=PLAN, chunk=None, precision=32):
    store = runner.start(path, plan, chunk, precision)
    runner.run(store, quiet)
    return store


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return complete(tmp_path_factory.mktemp("whole") / "tiny.zarr").path


@pytest.fixture(scope="module")
def estimated(tmp_path_factory):
    return complete(tmp_path_factory.mktemp("estimated") / "a.zarr", DOUBTED, chunk=12).path


def bits(path):
    """Every variable's bytes, read by xarray alone."""
    with xr.open_zarr(path, chunks=None) as data:
        return {name: (v.dims, v.dtype, v.values.tobytes()) for name, v in data.variables.items()}


def stopped(path, plan, chunk, cells):
    """A store whose run was interrupted after so many cells."""
    store = runner.start(path, plan, chunk, 32)

    def stop(progress):
        if progress.done >= cells:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runner.run(store, stop)
    return store


def test_a_cell_is_its_scenario(whole):
    """The value at a label is what `sweep` gives for that scenario, bit for bit."""
    data = xr.open_zarr(whole).sel(contact="hard_stop", Td=5.0).isel(K0=2, case=1)
    p = fic_jax.Params(
        K0=np.float32(data.K0), Td=np.float32(5.0), Denv=np.float32(63.2), gap=np.float32(0.1)
    )
    metrics = fic_jax.sweep(p, dt=0.01, n_steps=50)
    for name in ("nmse", "convergence_time", "peak_torque", "energy_in"):
        assert data[name].values == getattr(metrics, name)[0]


def test_a_scenario_of_a_sample_is_its_scenario(tmp_path):
    text = (
        'name = "drawn"\nmetrics = ["nmse", "peak_torque"]\n[time]\nt_end = 0.1\n'
        '[sample]\nn = 50\nmethod = "lhs"\nranges = { Td = { lin = [1.0, 5.0] } }'
    )
    data = xr.open_zarr(complete(tmp_path / "drawn.zarr", parse(text, "f"), chunk=16).path)
    assert set(data.data_vars) == {"nmse", "peak_torque", "status"}
    assert data["Td"].dims == ("scenario",)
    p = fic_jax.Params(Td=data["Td"].values.astype(np.float32))
    np.testing.assert_array_equal(data["nmse"], fic_jax.sweep(p, dt=0.01, n_steps=10).nmse)


@pytest.mark.parametrize("chunk", [1, 7])
def test_any_block_size_gives_the_same_bits(tmp_path, whole, chunk):
    complete(tmp_path / "other.zarr", chunk=chunk)
    assert bits(tmp_path / "other.zarr") == bits(whole)


def test_precision_is_the_stores(tmp_path, whole):
    complete(tmp_path / "double.zarr", precision=64)
    single, double = xr.open_zarr(whole), xr.open_zarr(tmp_path / "double.zarr")
    assert (single["nmse"].dtype, double["nmse"].dtype) == (np.float32, np.float64)
    # float32 carries seven digits; half a second of motion loses two or three of them
    np.testing.assert_allclose(single["nmse"], double["nmse"], rtol=1e-3)


def test_resume_runs_what_an_interruption_left(tmp_path, whole):
    path = stopped(tmp_path / "halted.zarr", PLAN, 7, 30).path
    half = xr.open_zarr(path, chunks=None)
    done = half["status"].values == store_format.OK
    assert 30 <= done.sum() < 60
    assert np.isfinite(half["nmse"].values[done]).all()
    assert np.isnan(half["nmse"].values[~done]).all()
    assert runner.run(runner.reopen(path, 32), quiet).ran == 60 - done.sum()
    assert bits(path) == bits(whole)
    again = runner.reopen(path, 32)
    assert runner.run(again, quiet).ran == 0
    assert again.group.attrs["end"]


@pytest.fixture
def tried(monkeypatch):
    """The blocks that are computed, in order; those in `fails` fail."""
    compute, order = runner._compute, []

    def start(grid, fails):
        blocks = list(grid.blocks())

        def computing(grid, block, *rest):
            order.append(blocks.index(block))
            if fails(order):
                raise MemoryError(f"no room for block {order[-1]}\nand a second line")
            return compute(grid, block, *rest)

        monkeypatch.setattr(runner, "_compute", computing)
        return order

    return start


def test_a_failing_block_runs_again_after_the_others_and_is_then_set_aside(tmp_path, whole, tried):
    """Block 3 fails once, block 1 always; a resume runs block 1."""
    store = runner.start(tmp_path / "failing.zarr", PLAN, 7, 32)
    n, lost = store.grid.n_blocks, cells_of(store.grid.block(1))
    order = tried(store.grid, lambda order: order[-1] == 1 or (order == [0, 1, 2, 3]))
    result = runner.run(store, quiet)
    assert order == [*range(n), 1, 3, 1]
    (aside,) = result.set_aside
    assert (aside.block, aside.outcome, aside.attempt) == (1, ledger.SET_ASIDE, runner.ATTEMPTS)
    assert aside.error == "MemoryError: no room for block 1"
    assert (result.done, result.ran) == (60 - lost, 60 - lost)
    with xr.open_zarr(store.path, chunks=None) as data:
        status = data["status"].values
        assert np.all(status[store.grid.block(1)] == store_format.FAILED)
        assert (status == store_format.OK).sum() == 60 - lost
        assert "end" not in data.attrs
    order = tried(store.grid, lambda order: False)
    order.clear()
    again = runner.run(runner.reopen(store.path, 32), quiet)
    assert (order, again.done, again.ran, again.set_aside) == ([1], 60, lost, ())
    assert bits(store.path) == bits(whole)


def test_the_block_in_which_a_process_was_killed_runs_last(tmp_path, tried):
    store = runner.start(tmp_path / "killed.zarr", PLAN, 15, 32)
    with locked(store.path) as lock:
        lock.computing(1)
        note = (store.path / "owner.lock").read_bytes()
    (store.path / "owner.lock").write_bytes(note)  # as a kill leaves it
    order = tried(store.grid, lambda order: False)
    runner.run(store, quiet)
    assert order == [0, *range(2, store.grid.n_blocks), 1]


def test_a_diverged_cell_has_a_status_and_no_numbers(tmp_path):
    wild = parse(
        'name = "wild"\n[time]\nt_end = 2.0\n[model]\ncontact = "welded"\n'
        "[axes]\nKenv = [100.0, 1e9]",
        "f",
    )
    store = complete(tmp_path / "wild.zarr", wild)
    data = xr.open_zarr(store.path)
    np.testing.assert_array_equal(data["status"], [store_format.OK, store_format.DIVERGED])
    assert np.isnan(data["nmse"][1])
    assert np.isnan(data["convergence_time"][1])
    assert Counts.of(store).cells == {"not run": 0, "ok": 1, "diverged": 1, "failed": 0}


# --- what a run refuses --------------------------------------------------------------------------


@pytest.mark.parametrize("key", provenance.IDENTITY)
def test_resume_refuses_a_store_whose_bits_it_would_not_continue(tmp_path, key):
    store = runner.start(tmp_path / "old.zarr", PLAN, 7, 32)
    if key != "dtype":
        change_attributes(store.path, **{key: "x"})
    with pytest.raises(SweepError, match=rf"another program \({key} was .*, is ") as refused:
        runner.reopen(store.path, 64 if key == "dtype" else 32)
    assert "\n" not in str(refused.value)


def test_resume_refuses_a_store_begun_with_fused_arithmetic_if_it_has_none(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "arithmetic", lambda: "lanes fused")
    path = runner.start(tmp_path / "fused.zarr", PLAN, 7, 32).path
    assert runner.reopen(path, 32)
    monkeypatch.setattr(provenance, "arithmetic", lambda: "lanes unfused")
    with pytest.raises(SweepError, match="arithmetic was lanes fused, is lanes unfused"):
        runner.reopen(path, 32)


def test_resume_ignores_what_changes_no_bit(tmp_path):
    path = runner.start(tmp_path / "old.zarr", PLAN, 7, 32).path
    change_attributes(path, fic_jax="0.0.1", revision="0123456789ab+", device="64 x cpu")
    assert runner.reopen(path, 32)


def test_values_that_lose_their_meaning_in_float32_are_refused(tmp_path):
    for text, told in {
        "I = [1e-50, 1.0]": "tiny in 32 bits: `axes.I` must be positive and finite, but is 0.",
        "K0 = [1e300, 1.0]": "tiny in 32 bits: `axes.K0` must be positive and finite, but is inf.",
        "xb = [0.1000000001]": "tiny in 32 bits: `xb` must be greater than x0 = 0.1, but is 0.1.",
    }.items():
        plan = parse('name = "tiny"\n[axes]\n' + text, "f")
        with pytest.raises(SweepError, match=re.escape(told)):
            runner.start(tmp_path / "a.zarr", plan, None, 32)
        assert not list(tmp_path.iterdir())


# --- error estimates -----------------------------------------------------------------------------


def test_estimates_are_those_of_the_engine_and_change_no_metric(tmp_path, estimated):
    grid = Grid(DOUBTED)
    batch = {k: np.float32(v) for k, v in vars(grid.params(next(grid.blocks()))).items()}
    metrics, errors = fic_jax.sweep(
        fic_jax.Params(**batch),
        model=fic_jax.Model(contact="welded"), dt=0.01, n_steps=20, error_estimate=True,
    )  # fmt: skip
    with xr.open_zarr(estimated, chunks=None) as data:
        good = metrics.finite.reshape(grid.shape)
        assert 0 < good.sum() < good.size
        for name in DOUBTED.metrics:
            expected = getattr(errors, name).reshape(grid.shape)
            np.testing.assert_array_equal(data[f"{name}_error"], np.where(good, expected, np.nan))
        trusted, counts = fic_jax.trusted(metrics, errors, 0.2), Counts.of(open_store(estimated))
        assert list(counts.trusted) == DOUBTED.metrics
        for name in DOUBTED.metrics:
            within = np.asarray(getattr(trusted, name)).reshape(grid.shape)
            flags = np.where(within, store_format.TRUSTED, store_format.NOT_TRUSTED)
            np.testing.assert_array_equal(
                data[f"{name}_trusted"], np.where(good, flags, store_format.NO_ESTIMATE)
            )
            assert counts.trusted[name] == within.sum()
        assert 0 < counts.trusted["nmse"] < good.sum()
        assert len(set(counts.trusted.values())) > 1
    plain = parse(ESTIMATED, "f", ("error_estimate=false",))
    without, whole = bits(complete(tmp_path / "plain.zarr", plain, chunk=12).path), bits(estimated)
    more = {f"{name}_{of}" for name in plain.metrics for of in ("error", "trusted")}
    assert set(whole) - set(without) == more
    assert without == {name: whole[name] for name in without}


def test_status_counts_the_trusted_cells_of_finished_blocks(tmp_path, estimated):
    store = stopped(tmp_path / "halted.zarr", DOUBTED, 12, 1)
    data = xr.open_zarr(store.path, chunks=None)
    done = (data["status"] != store_format.NOT_RUN).sum()
    assert 0 < done < 30
    lines = " ".join(messages.status_lines(store))
    for name in DOUBTED.metrics:
        trusted = (data[f"{name}_trusted"] == store_format.TRUSTED).sum()
        assert f" {name} {100 * float(trusted / done):.4g} %" in lines
    result = runner.run(runner.reopen(store.path, 32), quiet)
    assert bits(store.path) == bits(estimated)
    assert re.search(r"^trusted   nmse [\d.]+ %, ", messages.summary(store, result), re.MULTILINE)


def test_a_store_of_few_metrics_judges_them_alone(tmp_path, estimated):
    few = parse(ESTIMATED, "f", ('metrics=["peak_torque"]',))
    data = dataset(complete(tmp_path / "few.zarr", few).path)
    assert list(data) == ["peak_torque", "peak_torque_error", "peak_torque_trusted", "status"]
    np.testing.assert_array_equal(
        data["peak_torque_trusted"], dataset(estimated)["peak_torque_trusted"]
    )


def test_a_dry_run_accounts_for_estimates():
    grid = Grid(DOUBTED)
    assert messages.plan_lines(grid, "float32")[-1].endswith(", float32, error estimates included")
    assert runner.measure(grid, "float32")[1] > 0
    long = parse(ESTIMATED, "f", ("t_end=100",))
    plain = parse(ESTIMATED, "f", ("t_end=100", "error_estimate=false"))
    assert Grid(long).block_cells < Grid(plain).block_cells  # a block stays a second or two


# --- JAX -----------------------------------------------------------------------------------------


@pytest.fixture
def fresh(monkeypatch):
    """JAX as it is before a run sets it up, and afterwards as the tests have it."""
    names = (
        "jax_platforms",
        "jax_enable_x64",
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
    )
    before = {name: getattr(jax.config, name) for name in names}
    # it sets what can't be set once JAX has started, and has its own tests
    monkeypatch.setattr(runner, "tune_for_throughput", lambda cores: None)
    jax.config.update("jax_compilation_cache_dir", None)
    yield jax.config
    for name, value in before.items():
        jax.config.update(name, value)


def test_configure_sets_precision_and_device(fresh):
    preferred = fresh.jax_platforms
    for precision in (32, 64):
        runner.configure(precision)
        assert fresh.jax_enable_x64 == (precision == 64)
        assert fresh.jax_platforms == preferred
    runner.configure(32, "cpu")
    assert fresh.jax_platforms == "cpu"


def test_configure_refuses_a_device_that_does_not_exist(fresh):
    jax.config.update("jax_platforms", None)
    with pytest.raises(SweepError, match=r"^JAX [\d.]+ finds no abacus here; a GPU needs a driver"):
        runner.configure(32, "abacus")


def test_configure_leaves_an_existing_gpu_to_jax(fresh, monkeypatch):
    """JAX prefers it anyway; the processor stays for what is not put on it."""
    preferred = fresh.jax_platforms
    monkeypatch.setattr(jax, "devices", lambda platform: {"gpu": ["there"]}[platform])
    runner.configure(32, "gpu")
    assert fresh.jax_platforms == preferred


def test_xla_caches_with_our_compile_cache_or_in_the_users_folder(fresh, monkeypatch, tmp_path):
    monkeypatch.setenv(compile_cache.VARIABLE, "")
    runner.configure(32)
    assert fresh.jax_compilation_cache_dir is None
    monkeypatch.setenv(compile_cache.VARIABLE, str(tmp_path / "ours"))
    runner.configure(32)
    assert fresh.jax_compilation_cache_dir == str(compile_cache.folder())
    assert fresh.jax_persistent_cache_min_compile_time_secs == 0.2
    fresh.update("jax_compilation_cache_dir", str(tmp_path / "theirs"))
    runner.configure(32)
    assert fresh.jax_compilation_cache_dir == str(tmp_path / "theirs")
