"""The store: what xarray reads, the same bits whatever the chunking, and what it refuses."""

import json
import re
import warnings

import numpy as np
import pytest
import xarray as xr

import fic_jax
from sweeps import runner
from sweeps.cli import messages
from sweeps.export import tables, write
from sweeps.plan.grid import Grid, cells_of
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import format as layout
from sweeps.store import ledger
from sweeps.store import opening as store
from tests.changed import note

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


@pytest.fixture(scope="module")
def plan():
    return parse(TEXT, "tiny.toml")


def quiet(progress):
    pass


def complete(path, plan, chunk=None, precision=32):
    made = runner.start(path, plan, chunk, precision)
    runner.run(made, quiet)
    return made


@pytest.fixture(scope="module")
def whole(tmp_path_factory, plan):
    path = tmp_path_factory.mktemp("store") / "tiny.zarr"
    complete(path, plan)
    return path


def bits(path):
    """Every variable's bytes, read by xarray alone."""
    with xr.open_zarr(path, chunks=None) as data:
        return {name: (v.dims, v.dtype, v.values.tobytes()) for name, v in data.variables.items()}


def test_xarray_opens_it_without_our_code_and_without_a_warning(whole, plan):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = xr.open_zarr(whole)
    assert data["nmse"].dims == ("contact", "K0", "Td", "case")
    assert data.sizes == {"contact": 2, "K0": 5, "Td": 3, "case": 2}
    assert set(data.data_vars) == {*plan.metrics, "status"}
    assert data["K0"].attrs["units"] == "N*m/rad"
    assert data["convergence_time"].attrs == {
        "units": "s",
        "long_name": fic_jax.METRICS["convergence_time"]["meaning"],
    }
    np.testing.assert_array_equal(data["contact"], ["welded", "hard_stop"])
    np.testing.assert_array_equal(data["Denv"], [0.0, 63.2])  # a coordinate along `case`
    assert data["Denv"].dims == ("case",)
    assert (data["status"] == store.OK).all()
    for key in ("program", "revision", "jax", "device", "dtype", "start", "end", "sweep"):
        assert data.attrs[key], key
    assert json.loads(data.attrs["sweep"])["axes"]["Td"] == [1.0, 5.0, 20.0]


def test_a_cell_is_its_scenario(whole):
    """The value at a labelled place is what `sweep` gives for that scenario, bit for bit."""
    data = xr.open_zarr(whole).sel(contact="hard_stop", Td=5.0).isel(K0=2, case=1)
    p = fic_jax.Params(
        K0=np.float32(data.K0), Td=np.float32(5.0), Denv=np.float32(63.2), gap=np.float32(0.1)
    )
    metrics = fic_jax.sweep(p, dt=0.01, n_steps=50)
    for name in ("nmse", "convergence_time", "peak_torque", "energy_in"):
        assert data[name].values == getattr(metrics, name)[0]


def test_values_that_lose_their_meaning_in_float32_are_refused(tmp_path):
    """Good in 64 bits, nothing written in 32."""
    for text, told in {
        "I = [1e-50, 1.0]": "tiny in 32 bits: `axes.I` must be positive and finite, but is 0.",
        "K0 = [1e300, 1.0]": "tiny in 32 bits: `axes.K0` must be positive and finite, but is inf.",
        "xb = [0.1000000001]": "tiny in 32 bits: `xb` must be greater than x0 = 0.1, but is 0.1.",
    }.items():
        plan = parse('name = "tiny"\n[axes]\n' + text, "f")
        with pytest.raises(SweepError, match=re.escape(told)):
            runner.start(tmp_path / "a.zarr", plan, None, 32)
        assert not list(tmp_path.iterdir())


def test_size_counts_coordinates(tmp_path):
    text = 'name = "a"\nmetrics = ["nmse"]\n[sample]\nn = 1000\nranges = { Td = { lin = [1, 2] } }'
    assert layout.size(Grid(parse(text, "f")), "float32") == 1000 * (4 + 1 + 8)


@pytest.mark.parametrize("chunk", [1, 7, 10])
def test_any_chunk_size_gives_the_same_store(tmp_path, plan, whole, chunk):
    complete(tmp_path / "other.zarr", plan, chunk)
    assert bits(tmp_path / "other.zarr") == bits(whole)


def test_precision_is_the_stores(tmp_path, plan, whole):
    complete(tmp_path / "double.zarr", plan, precision=64)
    single, double = xr.open_zarr(whole), xr.open_zarr(tmp_path / "double.zarr")
    assert (single["nmse"].dtype, double["nmse"].dtype) == (np.float32, np.float64)
    # float32 carries seven digits; half a second of motion loses two or three of them
    np.testing.assert_allclose(single["nmse"], double["nmse"], rtol=1e-3)


def test_interrupted_run_keeps_finished_blocks_and_resume_does_the_rest(tmp_path, plan, whole):
    path = tmp_path / "halted.zarr"
    made = runner.start(path, plan, 7, 32)

    def stop(progress):
        if progress.done >= 30:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runner.run(made, stop)
    half = xr.open_zarr(path, chunks=None)
    done = half["status"].values == store.OK
    assert 30 <= done.sum() < 60
    assert np.isfinite(half["nmse"].values[done]).all()
    assert np.isnan(half["nmse"].values[~done]).all()  # fill values elsewhere
    ran = runner.run(runner.reopen(path, 32), quiet).ran
    assert ran == 60 - done.sum()
    assert bits(path) == bits(whole)
    again = runner.reopen(path, 32)
    assert runner.run(again, quiet).ran == 0
    assert again.group.attrs["end"]


def test_a_block_that_fails_is_tried_again_after_all_others_and_set_aside_in_the_end(
    tmp_path, plan, whole, monkeypatch
):
    """Block 3 fails once, block 1 always; the sweep goes on without it, and a resume has both."""
    path, compute, tried = tmp_path / "failing.zarr", runner._compute, []
    made = runner.start(path, plan, 7, 32)
    blocks = list(made.grid.blocks())

    def failing(grid, block, *rest):
        index = blocks.index(block)
        tried.append(index)
        if index == 1 or (index == 3 and tried.count(3) == 1):
            raise MemoryError(f"no room for block {index}\nand a second line")
        return compute(grid, block, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(runner, "_compute", failing)
        result = runner.run(made, quiet)
    assert tried == [*range(len(blocks)), 1, 3, 1]
    (aside,) = result.set_aside
    assert (aside.block, aside.outcome, aside.attempt) == (1, ledger.SET_ASIDE, runner.ATTEMPTS)
    assert aside.error == "MemoryError: no room for block 1"
    lost = cells_of(blocks[1])
    assert (result.done, result.ran) == (60 - lost, 60 - lost)
    with xr.open_zarr(path, chunks=None) as data:
        status = data["status"].values
        assert np.all(status[blocks[1]] == store.FAILED)
        assert (status == store.OK).sum() == 60 - lost
        assert "end" not in data.attrs
    again = runner.run(runner.reopen(path, 32), quiet)
    assert (again.done, again.ran, again.set_aside) == (60, lost, ())
    assert bits(path) == bits(whole)


def test_resume_refuses_another_program(tmp_path, plan):
    path = tmp_path / "old.zarr"
    runner.start(path, plan, 7, 32)
    note(path, program="0123456789abcdef")
    with pytest.raises(
        SweepError, match=r"begun by another program \(program was 0123456789abcdef"
    ):
        runner.reopen(path, 32)


def test_resume_refuses_another_precision(tmp_path, plan):
    path = tmp_path / "single.zarr"
    runner.start(path, plan, 7, 32)
    with pytest.raises(SweepError, match="dtype was float32, is float64"):
        runner.reopen(path, 64)


def test_a_changed_sweep_record_is_refused(tmp_path, plan):
    path = tmp_path / "changed.zarr"
    runner.start(path, plan, 7, 32)
    note(path, sweep=plan.record().replace("300.0", "200.0"))
    with pytest.raises(SweepError, match="sweep record differs"):
        store.open_store(path)


@pytest.mark.parametrize("what", ["nothing", "file", "folder", "foreign"])
def test_what_is_no_store_is_refused(tmp_path, what):
    path = tmp_path / "x.zarr"
    if what == "file":
        path.write_text("hello")
    elif what == "folder":
        path.mkdir()
    elif what == "foreign":
        xr.Dataset({"a": ("x", [1.0])}).to_zarr(path, consolidated=False)
    for opened in (store.open_store, store.dataset):
        with pytest.raises(SweepError, match="is no result store") as caught:
            opened(path)
        assert "\n" not in str(caught.value)


def test_an_existing_path_is_never_touched(tmp_path, plan):
    path = tmp_path / "kept.zarr"
    path.mkdir()
    (path / "mine.txt").write_text("precious")
    with pytest.raises(SweepError, match="exists already"):
        runner.start(path, plan, None, 32)
    assert [p.name for p in tmp_path.rglob("*")] == ["kept.zarr", "mine.txt"]


def test_an_unwritable_path_leaves_nothing(tmp_path, plan):
    (tmp_path / "file").write_text("")
    with pytest.raises(SweepError, match="can't be written: "):
        runner.start(tmp_path / "file" / "a.zarr", plan, None, 32)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_disk_too_small_is_refused(tmp_path):
    axes = "".join(f"{name} = {{ lin = [1, 9], n = 1000 }}\n" for name in ("K0", "Kenv", "Td"))
    huge = parse('name = "huge"\n[axes]\n' + axes + "I = { lin = [1, 9], n = 1000 }", "f")
    with pytest.raises(SweepError, match=r"needs up to 4.1e\+04 GB for 1,000,000,000,000 cells"):
        runner.start(tmp_path / "huge.zarr", huge, None, 32)
    assert not list(tmp_path.iterdir())


def test_diverged_cells_are_a_status_and_keep_no_numbers(tmp_path):
    wild = parse(
        'name = "wild"\n[time]\nt_end = 2.0\n[model]\ncontact = "welded"\n'
        "[axes]\nKenv = [100.0, 1e9]",
        "f",
    )
    made = complete(tmp_path / "wild.zarr", wild)
    data = xr.open_zarr(tmp_path / "wild.zarr")
    np.testing.assert_array_equal(data["status"], [store.OK, store.DIVERGED])
    assert np.isnan(data["nmse"][1])
    assert np.isnan(data["convergence_time"][1])
    assert store.Tally.of(made).cells == {"not run": 0, "ok": 1, "diverged": 1, "failed": 0}


def test_a_flipped_bit_is_noticed(tmp_path, plan):
    """The checksum of the codec: damaged numbers raise instead of being read."""
    complete(tmp_path / "a.zarr", plan)
    chunk = next((tmp_path / "a.zarr" / "nmse").glob("c.*"))
    damaged = bytearray(chunk.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    chunk.write_bytes(damaged)
    with pytest.raises(Exception, match="checksum"):
        xr.open_zarr(tmp_path / "a.zarr", chunks=None)["nmse"].load()


def test_a_sample_keeps_each_scenarios_values(tmp_path):
    text = (
        'name = "drawn"\nmetrics = ["nmse", "peak_torque"]\n[time]\nt_end = 0.1\n'
        '[sample]\nn = 50\nmethod = "lhs"\nranges = { Td = { lin = [1.0, 5.0] } }'
    )
    complete(tmp_path / "drawn.zarr", parse(text, "f"), chunk=16)
    data = xr.open_zarr(tmp_path / "drawn.zarr")
    assert set(data.data_vars) == {"nmse", "peak_torque", "status"}
    assert data["Td"].dims == ("scenario",)
    metrics = fic_jax.sweep(
        fic_jax.Params(Td=data["Td"].values.astype(np.float32)), dt=0.01, n_steps=10
    )
    np.testing.assert_array_equal(data["nmse"], metrics.nmse)


ESTIMATED = """
name = "estimated"
description = "easy, hard and unstable cells"
error_estimate = true
[time]
t_end = 0.5
[model]
contact = "welded"
[axes]
K0 = { log = [1.0, 300.0], n = 5 }
Kenv = [100.0, 3000.0, 1e9]
[cases]
Denv = [0.0, 63.2]
"""


@pytest.fixture(scope="module")
def doubted():
    return parse(ESTIMATED, "estimated.toml")


@pytest.fixture(scope="module")
def estimated(tmp_path_factory, doubted):
    path = tmp_path_factory.mktemp("estimated") / "estimated.zarr"
    complete(path, doubted, chunk=12)
    return path


def test_estimates_are_those_of_the_engine_and_change_no_metric(tmp_path, doubted, estimated):
    grid = Grid(doubted)
    batch = {k: np.float32(v) for k, v in vars(grid.params(next(grid.blocks()))).items()}
    metrics, errors = fic_jax.sweep(
        fic_jax.Params(**batch),
        model=fic_jax.Model(contact="welded"), dt=0.01, n_steps=50, error_estimate=True,
    )  # fmt: skip
    with xr.open_zarr(estimated, chunks=None) as data:
        good = metrics.finite.reshape(grid.shape)
        assert 0 < good.sum() < good.size
        for name in doubted.metrics:
            expected = getattr(errors, name).reshape(grid.shape)
            np.testing.assert_array_equal(data[f"{name}_error"], np.where(good, expected, np.nan))
        trusted = fic_jax.trusted(metrics, errors).reshape(grid.shape)
        assert 0 < trusted.sum() < good.sum()
        flags = np.where(trusted, store.TRUSTED, store.NOT_TRUSTED)
        np.testing.assert_array_equal(data["trusted"], np.where(good, flags, store.NO_ESTIMATE))
        assert store.Tally.of(store.open_store(estimated)).trusted == trusted.sum()
    plain = parse(ESTIMATED, "f", ("error_estimate=false",))
    complete(tmp_path / "plain.zarr", plain, chunk=12)
    without, whole = bits(tmp_path / "plain.zarr"), bits(estimated)
    assert set(whole) - set(without) == {f"{name}_error" for name in plain.metrics} | {"trusted"}
    assert without == {name: whole[name] for name in without}


def test_estimates_say_what_they_are(tmp_path, plan, estimated):
    bare = runner.start(tmp_path / "bare.zarr", plan, None, 32)
    with xr.open_zarr(estimated) as data, xr.open_zarr(bare.path) as plain:
        assert data["peak_torque_error"].attrs == {
            "units": "N*m",
            "long_name": "estimated error of largest interaction torque",
        }
        assert data["trusted"].dtype == np.uint8
        assert data["trusted"].attrs["flag_values"] == [0, 1, 2]
        assert data["trusted"].attrs["flag_meanings"] == "no_estimate not_trusted trusted"
        assert (data.attrs["error_estimate"], data.attrs["trust_bound"]) == (1, fic_jax.TRUST)
        assert "half the plant step" in data.attrs["error_estimate_meaning"]
        assert "error_estimate" not in data.attrs["sweep"]  # what older programs would refuse
        assert (plain.attrs["error_estimate"], "trust_bound" in plain.attrs) == (0, False)
        errors, metric = data["nmse_error"].encoding, data["nmse"].encoding
        for key in ("dtype", "chunks", "compressors"):
            assert errors[key] == metric[key]


def test_what_is_trusted_is_told_of_the_blocks_that_are_done(tmp_path, doubted, estimated):
    path = tmp_path / "halted.zarr"
    made = runner.start(path, doubted, 12, 32)

    def stop(progress):
        if progress.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runner.run(made, stop)
    data = xr.open_zarr(path, chunks=None)
    done, trusted = (
        (data["status"] != store.NOT_RUN).sum(),
        (data["trusted"] == store.TRUSTED).sum(),
    )
    assert 0 < trusted <= done < 30
    told = "\n".join(messages.status_lines(made))
    assert f"trusted   {int(trusted)} of {int(done)} cells (" in told
    result = runner.run(runner.reopen(path, 32), quiet)
    assert bits(path) == bits(estimated)
    assert re.search(
        r"; trusted 1\d of 30 cells \([\d.]+ %\), nmse known to 1 %$",
        messages.summary(made, result),
    )


def test_a_store_without_nmse_knows_what_is_trusted(tmp_path, doubted, estimated):
    few = parse(ESTIMATED, "f", ('metrics=["peak_torque"]',))
    complete(tmp_path / "few.zarr", few)
    data = store.dataset(tmp_path / "few.zarr")
    assert list(data) == ["peak_torque", "peak_torque_error", "trusted", "status"]
    np.testing.assert_array_equal(data["trusted"], store.dataset(estimated)["trusted"])


def test_a_dry_run_accounts_for_estimates(doubted):
    grid = Grid(doubted)
    assert layout.size(grid, "float32") == 30 * (2 * 10 * 4 + 2) + (5 + 3 + 2 * 2) * 8
    assert messages.plan_lines(grid, "float32")[-1].endswith(", error estimates included")
    assert runner.measure(grid, "float32")[1] > 0
    long = parse(ESTIMATED, "f", ("t_end=100",))
    plain = parse(ESTIMATED, "f", ("t_end=100", "error_estimate=false"))
    assert Grid(long).block_cells < Grid(plain).block_cells  # a block stays a second or two


def test_a_long_coordinate_is_written_piece_by_piece(tmp_path, monkeypatch):
    """Each piece drawn by itself, the last one shorter."""
    text = (
        'name = "drawn"\nmetrics = ["nmse"]\n[model]\ncontact = ["welded", "hard_stop"]\n'
        "[sample]\nn = 10\nranges = { Td = { lin = [1.0, 5.0] }, K0 = { log = [1.0, 9.0] } }"
    )
    once = runner.start(tmp_path / "once.zarr", parse(text, "f"), None, 32).path
    for module in (layout, store):
        monkeypatch.setattr(module, "COORDINATE_CHUNK", 4)
    pieces = runner.start(tmp_path / "pieces.zarr", parse(text, "f"), None, 32).path
    assert sorted(file.name for file in (pieces / "Td").glob("c.*")) == ["c.0", "c.1", "c.2"]
    assert bits(pieces) == bits(once)


def test_exports_carry_estimates_in_order(tmp_path, doubted, estimated):
    (table,) = tables(store.dataset(estimated))
    errors = [f"{name}_error" for name in doubted.metrics]
    named = ["K0", "Kenv", "case", "Denv", *doubted.metrics, *errors, "trusted", "status"]
    assert list(table.columns) == named
    assert set(table["trusted"]) == {"no estimate", "not trusted", "trusted"}
    assert set(table["status"][table["trusted"] == "no estimate"]) == {"diverged"}
    write(store.dataset(estimated), tmp_path / "a.nc", "netcdf")
    with xr.open_dataset(tmp_path / "a.nc") as copy, xr.open_zarr(estimated) as data:
        np.testing.assert_array_equal(copy["trusted"], data["trusted"])
        np.testing.assert_array_equal(copy["nmse_error"], data["nmse_error"])
