"""Reduced stores: numpy's reduction of the cells, the same bits however they came about."""

import itertools
import re
import shutil
import signal
import threading
import time

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from figures import planes
from figures.cut import PlotError
from sweeps import runner
from sweeps.cli import messages
from sweeps.plan.grid import FEW_BLOCKS, LARGEST_BLOCK, Grid, cells_of, shape_of
from sweeps.reduce import fold
from sweeps.reduce.stored import reduce_store, reduced_sweep
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store.format import DIVERGED, NOT_RUN, NOT_TRUSTED, OK, TRUSTED, UNTRUSTED
from sweeps.store.opening import dataset, open_store
from tests.test_runner import bits, complete, quiet, stopped

# Some cells diverge (Kenv = 1e9, welded), some never converge, some are not trusted.
FULL = """
name = "full"
error_estimate = true
[time]
t_end = 0.6
[model]
contact = ["welded", "hard_stop"]
integrator = ["rk4", "rk4_events"]
[axes]
K0 = { log = [1.0, 300.0], n = 3 }
Denv = { log = [1.0, 1000.0], n = 5 }
Kenv = [30.0, 300.0, 1e9]
sigma = [0.003, 0.01, 0.1]
Td = [1.0, 5.0]
"""
TABLE = """
over = ["Td", "Denv"]
max = ["nmse", "convergence_time", "steady_error"]
min = ["nmse", "convergence_time"]
mean = ["nmse", "convergence_time", "peak_torque"]
std = ["nmse", "convergence_time", "peak_torque"]
quantiles = { nmse = [0.0, 0.5, 0.95, 1.0], convergence_time = [0.75] }
share = { calm = "nmse_tail < 1e-2 and contact_lost == 0 and Td > 2", easy = "nmse < 0.3" }
untrusted = 0.25
"""
PLAIN = parse(FULL + "[reduce]" + TABLE, "plain.toml")
BEST = parse(FULL + "[reduce]" + TABLE + 'best = "sigma"\nby = "nmse"\n', "best.toml")


@pytest.fixture(scope="module")
def full(memory):
    return complete(memory / "full.zarr", parse(FULL, "full.toml"), chunk=50)


@pytest.fixture(scope="module", params=["plain", "best"])
def reduced(request, memory):
    """The store of a sweep that is reduced while it runs."""
    plan = {"plain": PLAIN, "best": BEST}[request.param]
    return complete(memory / f"{request.param}.zarr", plan)


# --- the reference: one cell at a time, by numpy -------------------------------------------------


PARTS = (0.0, 0.5, 0.75, 0.95, 1.0)
KINDS = ["max", "min", "mean", "std", *(f"q{100 * part:g}" for part in PARTS)]
KINDS += [f"{key}_{field}" for key in ("max", "min") for field in ("Td", "Denv")]
NAMES = {
    metric: [f"{metric}_{kind}" for kind in KINDS]
    for metric in ("nmse", "convergence_time", "steady_error", "peak_torque")
}


def scenarios(data, kept, over):
    """Flat arrays of the scenarios of each place along the dimensions `kept`, C order of `over`."""
    for index in np.ndindex(*(data.sizes[dim] for dim in kept)):
        part = data.isel(dict(zip(kept, index, strict=True))).transpose(*over)
        fields = xr.broadcast(*(part[dim] for dim in over))
        flat = {str(name): part[name].values.ravel() for name in part.data_vars}
        yield index, flat, {f.name: f.values.ravel() for f in fields}


def statistics(flat, fields, allowed):
    """What the store must have of some scenarios, by variable."""
    status = np.nan_to_num(flat["status"])
    ran, n, out = status == OK, len(status), {}
    out["diverged_share"] = np.mean(status == DIVERGED)
    out["not_run_share"] = np.mean((status != DIVERGED) & ~ran)

    def judged(name, metrics):
        used = np.all([ran, *(~np.isnan(flat[m]) for m in metrics)], axis=0)
        known = np.all([used, *(flat[f"{m}_trusted"] == TRUSTED for m in metrics)], axis=0)
        out[f"{name}_untrusted_share"] = np.mean(ran & ~known)
        refused = (~known).sum() > allowed * n or not used.any()
        shares = ("diverged_share", f"{name}_untrusted_share", "not_run_share")
        kinds = (DIVERGED, UNTRUSTED, NOT_RUN)
        most = max(zip((out[key] for key in shares), (3, 2, 1), kinds, strict=True))[2]
        out[f"{name}_status"] = most if refused else OK
        return used

    for metric, names in NAMES.items():
        used = judged(metric, [metric])
        if out[f"{metric}_status"] != OK:
            out |= dict.fromkeys(names, np.nan)
            continue
        v = flat[metric][used]
        for key, at in (("max", np.argmax), ("min", np.argmin)):
            out[f"{metric}_{key}"] = v[at(v)]
            out |= {f"{metric}_{key}_{f}": values[used][at(v)] for f, values in fields.items()}
        wide = v.astype(float)
        out[f"{metric}_mean"] = wide.mean()
        out[f"{metric}_std"] = np.std(wide) if np.isfinite(wide).all() else np.inf
        for part in PARTS:
            out[f"{metric}_q{100 * part:g}"] = np.quantile(v, part, method="inverted_cdf")
    calm = judged("calm", ["nmse_tail", "contact_lost"])
    easy = judged("easy", ["nmse"])
    with np.errstate(invalid="ignore"):
        true = (flat["nmse_tail"] < 1e-2) & (flat["contact_lost"] == 0) & (fields["Td"] > 2)
        shares = {"calm": (true, calm), "easy": (flat["nmse"] < 0.3, easy)}
    for name, (true, used) in shares.items():
        good = out[f"{name}_status"] == OK
        out[f"{name}_share"] = np.mean(true[used]) if good else np.nan
    return out


def by_the_best(candidates, sigma, allowed):
    """The statistics at the sigma with the smallest worst case, as docs/reduce.md says."""
    found = [statistics(flat, fields, allowed) for flat, fields in candidates]
    worst = []
    for flat, _ in candidates:
        ran = flat["status"] == OK
        diverged = (flat["status"] == DIVERGED).any()
        worst.append(np.inf if diverged else flat["nmse"][ran].max(initial=-np.inf))
    refused = [one["nmse_untrusted_share"] > allowed or one["not_run_share"] > 0 for one in found]
    at = min(range(len(found)), key=lambda i: (worst[i], refused[i], i))
    out = dict(found[at])
    if refused[at]:
        why = NOT_RUN if out["nmse_status"] == OK else out["nmse_status"]
        for name in out:
            if name.endswith("_status"):
                out[name] = why
    none = refused[at] or worst[at] == np.inf
    for name in out:
        if none and not name.endswith(("_status", "diverged_share", "_run_share", "rusted_share")):
            out[name] = np.nan
    out["best_sigma"] = np.nan if none else sigma[at]
    out["nmse_at_best"] = np.nan if refused[at] else worst[at]
    return out


def close(name, dtype):
    """Relative tolerance: a mean or deviation is summed in another order, then rounded once."""
    return 2 * np.finfo(dtype).eps if name.endswith(("_mean", "_std")) else 0.0


def test_a_reduced_run_is_numpys_reduction_of_the_cells(full, reduced):
    cells, plan = dataset(full.path).load(), reduced.grid.sweep
    data, over, seen = dataset(reduced.path).load(), ["Denv", "Td"], set()
    best = plan.reduce.best
    kept = [dim for dim in plan.dims if dim not in over and dim != best]
    assert list(data.sizes) == kept
    candidates = [cells.isel(sigma=i) for i in range(cells.sizes["sigma"])] if best else [cells]
    for places in zip(*(scenarios(part, kept, over) for part in candidates), strict=True):
        index = places[0][0]
        if best:
            both = [(flat, fields) for _, flat, fields in places]
            expected = by_the_best(both, cells["sigma"].values, 0.25)
        else:
            expected = statistics(*places[0][1:], 0.25)
        for name in set(data.data_vars) - {"status"}:
            found, right = data[name].values[index], expected[name]
            right = np.asarray(right).astype(data[name].dtype)
            rtol = close(name, np.float32)
            np.testing.assert_allclose(found, right, rtol, 0.0, err_msg=f"{name} at {index}")
        seen |= {(s, int(data[f"{s}_status"].values[index])) for s in ("nmse", "convergence_time")}
    # the test has cells of every kind
    assert {code for _, code in seen} >= {OK, DIVERGED, UNTRUSTED}
    assert np.isinf(data["convergence_time_max"]).any()
    assert (data["status"] == OK).all()


# --- the same bits -------------------------------------------------------------------------------


def test_any_block_size_gives_the_same_bits(tmp_path, reduced):
    again = complete(tmp_path / "again.zarr", reduced.grid.sweep, chunk=4)
    assert again.grid.n_blocks > reduced.grid.n_blocks
    assert bits(again.path) == bits(reduced.path)


def test_a_store_reduced_after_its_run_has_the_bits_of_a_reduced_run(tmp_path, full, reduced):
    table = reduced.grid.sweep.reduce.model_dump(exclude_none=True)
    path = tmp_path / "after.zarr"
    after = reduce_store(full, reduced_sweep(full, table), path, 7, lambda *_: None)
    assert bits(after.path) == bits(reduced.path)
    assert after.group.attrs["reduced_from"] == "full.zarr"
    assert "end" in open_store(path).group.attrs


def test_an_interrupted_reduction_is_resumed(tmp_path, full, reduced):
    path = stopped(tmp_path / "halted.zarr", reduced.grid.sweep, 5, 1).path
    assert runner.run(runner.reopen(path, 32), quiet).ran > 0
    assert bits(path) == bits(reduced.path)

    def stop(*_):
        raise KeyboardInterrupt

    table = reduced.grid.sweep.reduce.model_dump(exclude_none=True)
    path = tmp_path / "after.zarr"
    with pytest.raises(KeyboardInterrupt):
        reduce_store(full, reduced_sweep(full, table), path, 5, stop)
    assert runner.run(runner.reopen(path, 32), quiet).ran > 0  # computes what was not read
    assert bits(path) == bits(reduced.path)


# --- any values, any boxes -----------------------------------------------------------------------

ANY = """
name = "any"
error_estimate = true
[axes]
K0 = [1.0, 2.0, 3.0]
Denv = [1.0, 2.0, 3.0, 4.0]
sigma = [0.1, 0.2]
Td = [1.0, 2.0, 3.0]
[cases]
gap = [0.0, 0.1]
xd = [0.0, 0.1]
[reduce]
over = ["Td", "case", "Denv"]
max = ["nmse"]
min = ["nmse"]
mean = ["nmse"]
std = ["nmse"]
quantiles = { nmse = [0.3] }
share = { high = "nmse >= 2 and not gap > 0.05" }
untrusted = 0.9
"""


def cells_from(grid, seed, ties):
    """Metrics of all scenarios as a function of boxes: some infinite, doubted, diverged, absent."""
    rng, shape = np.random.default_rng(seed), grid.full.shape
    nmse = rng.integers(0, 4, shape) if ties else rng.lognormal(size=shape)
    nmse = np.where(rng.random(shape) < 0.1, np.inf, nmse).astype(np.float32)
    status = rng.choice([OK, DIVERGED, NOT_RUN], shape, p=[0.8, 0.1, 0.1])
    trusted = rng.choice([TRUSTED, NOT_TRUSTED], shape, p=[0.8, 0.2])
    nmse = np.where(status == OK, nmse, np.float32(np.nan))
    whole = {"nmse": nmse, "status": status, "nmse_trusted": trusted}
    return lambda box: {name: values[box].ravel() for name, values in whole.items()}


def assembled(grid, cells):
    """The whole store, block by block."""
    whole = {}
    for block in grid.blocks():
        for name, values in fold.block_values(grid, block, cells).items():
            assert values.shape == (cells_of(block),)
            into = whole.setdefault(name, np.zeros(grid.shape, values.dtype))
            into[block] = values.reshape(shape_of(block))
    return whole


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    ties=st.booleans(),
    best=st.booleans(),
    chunks=st.lists(st.integers(1, 6), min_size=1, max_size=2),
    most=st.sampled_from([1, 5, 24, 10**6]),
)
def test_bits_depend_on_no_block_and_extremes_on_no_box(seed, ties, best, chunks, most):
    more = 'best = "sigma"\nby = "nmse"' if best else ""
    plan = parse(ANY + more, "any.toml")
    cells = cells_from(Grid(plan), seed, ties)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fold, "LARGEST_BLOCK", 10**6)
        whole = assembled(Grid(plan), cells)
        patch.setattr(fold, "LARGEST_BLOCK", most)
        one, *others = (assembled(Grid(plan, chunk), cells) for chunk in (100, *chunks))
    for other in others:
        for name, values in one.items():
            assert values.tobytes() == other[name].tobytes(), name
    known = one["nmse_max_case"] >= 0  # not NaN
    gap = np.array([0.0, 0.1])[np.where(known, one["nmse_max_case"], 0).astype(int)]
    np.testing.assert_array_equal(one["nmse_max_gap"], np.where(known, gap, np.nan))
    for name, values in one.items():
        # sums of a few numbers, box by box
        rtol = 1e-13 if name in ("nmse_mean", "nmse_std") else 0.0
        np.testing.assert_allclose(values, whole[name], rtol, 1e-13 if rtol else 0.0, err_msg=name)


@pytest.mark.parametrize("dims", [("Td", "K0"), ("K0", "Td")])
def test_a_long_sum_does_not_depend_on_the_cells_beside_it(dims):
    """numpy sums in another order along another layout of its memory."""
    axes = {"Td": "Td = { lin = [1, 9], n = 3000 }\n", "K0": "K0 = { lin = [1, 9], n = 5 }\n"}
    text = 'name = "a"\n[axes]\n' + "".join(axes[dim] for dim in dims)
    plan = parse(text + '[reduce]\nover = ["Td"]\nmean = ["nmse"]\nstd = ["nmse"]\n', "f")
    values = np.random.default_rng(0).lognormal(size=Grid(plan).full.shape).astype(np.float32)

    def cells(box):
        n = cells_of(box)
        return {"nmse": values[box].ravel(), "status": np.full(n, OK)}

    whole, alone = (assembled(Grid(plan, chunk), cells) for chunk in (5, 1))
    for name in ("nmse_mean", "nmse_std"):
        assert whole[name].dtype == np.float64
        assert whole[name].tobytes() == alone[name].tobytes()


def test_a_box_has_one_model_and_fits_into_memory():
    text = ANY.replace("[axes]", '[model]\ncontact = ["welded", "hard_stop"]\n[axes]')
    plan = parse(text.replace('["Td", ', '["contact", "Td", '), "f")
    sizes = []

    def cells(box):
        assert box[0].stop - box[0].start == 1
        sizes.append(cells_of(box))
        n = sizes[-1]
        return {"nmse": np.ones(n), "status": np.full(n, OK), "nmse_trusted": np.full(n, TRUSTED)}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fold, "LARGEST_BLOCK", 20)
        values = fold.block_values(Grid(plan), next(Grid(plan).blocks()), cells)
    assert max(sizes) <= 20 and sum(sizes) == Grid(plan).full.cells
    assert set(values["nmse_max_contact"]) == {1}  # the first of equals; 0 is none


def test_a_box_is_computed_while_the_one_before_is_reduced(monkeypatch):
    plan = parse(ANY, "any.toml")
    values, computed, begun = cells_from(Grid(plan), 0, False), [], threading.Event()

    def cells(box):
        computed.append(box)
        if len(computed) == 2:
            begun.set()
        return values(box)

    def count(self, status, folded=fold.Totals.count):
        assert begun.wait(30), "the second box waits for the first"
        folded(self, status)

    monkeypatch.setattr(fold, "LARGEST_BLOCK", 5)
    monkeypatch.setattr(fold.Totals, "count", count)
    fold.block_values(Grid(plan, 100), next(Grid(plan, 100).blocks()), cells)
    assert len(computed) > 2


def test_a_stop_waits_for_no_other_box(monkeypatch):
    """A box may take minutes; the next one is in the queue by then."""
    computed = []

    def cells(box):
        computed.append(box)
        time.sleep(0.3)  # until both boxes are in the queue
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        time.sleep(0.3)  # until the main thread has been interrupted
        return {}

    monkeypatch.setattr(fold, "LARGEST_BLOCK", 5)
    plan = parse(ANY, "any.toml")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            fold.block_values(Grid(plan, 100), next(Grid(plan, 100).blocks()), cells)
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(computed) == 1


def test_a_random_design_and_choices_are_reduced_by_name(tmp_path):
    text = (
        'name = "drawn"\nmetrics = ["nmse"]\n[time]\nt_end = 0.1\n'
        '[model]\ncontact = ["welded", "hard_stop"]\nlaw = ["algorithm1", "effort"]\n'
        "[sample]\nn = 50\nranges = { Td = { lin = [1.0, 5.0] }, K0 = { log = [1.0, 99.0] } }\n"
    )
    cells = dataset(complete(tmp_path / "all.zarr", parse(text, "f")).path).load()
    more = '[reduce]\nover = ["scenario"]\nmax = ["nmse"]\nbest = "law"\nby = "nmse"\n'
    data = dataset(complete(tmp_path / "few.zarr", parse(text + more, "f")).path).load()
    worst = cells["nmse"].max("scenario")
    np.testing.assert_array_equal(data["nmse_at_best"], worst.min("law"))
    np.testing.assert_array_equal(data["best_law"], worst.argmin("law") + 1)
    assert data["best_law"].attrs["flag_meanings"] == "none algorithm1 effort"
    at = data["nmse_max_scenario"].astype(int)
    law = data["best_law"].astype(int) - 1
    np.testing.assert_array_equal(cells["nmse"].isel(scenario=at, law=law), data["nmse_max"])
    for name in ("Td", "K0"):
        np.testing.assert_array_equal(data[f"nmse_max_{name}"], cells[name].values[at])
        assert data[f"nmse_max_{name}"].dtype == np.float64


# --- what was not run ----------------------------------------------------------------------------


def test_what_a_store_lacks_is_counted_and_refused(tmp_path):
    store = stopped(tmp_path / "half.zarr", parse(FULL, "full.toml"), 20, 100)
    table = {"over": ["sigma", "Kenv"], "max": ["contact_time"]}
    sweep = reduced_sweep(store, table)
    data = dataset(reduce_store(store, sweep, tmp_path / "r.zarr", None, lambda *_: None).path)
    cells = dataset(store.path)
    absent = (cells["status"].fillna(0) == NOT_RUN).mean(["sigma", "Kenv"])
    assert 0 < float(absent.mean()) < 1
    np.testing.assert_array_equal(data["not_run_share"], absent.astype(np.float32))
    assert data["contact_time_max"].isnull().where(absent > 0, True).all()
    assert (data["contact_time_status"].fillna(0).where(absent == 1, NOT_RUN) == NOT_RUN).all()


def test_a_store_without_a_block_is_refused(tmp_path):
    store = runner.start(tmp_path / "none.zarr", parse(FULL, "full.toml"), 20, 32)
    sweep = reduced_sweep(store, {"over": ["sigma"], "max": ["nmse"]})
    with pytest.raises(SweepError, match="no finished block, so there is nothing to reduce"):
        reduce_store(store, sweep, tmp_path / "r.zarr", None, lambda *_: None)
    assert not (tmp_path / "r.zarr").exists()


def test_a_damaged_block_is_not_reduced(tmp_path, full):
    copy = shutil.copytree(full.path, tmp_path / "copy.zarr")
    file = next((copy / "nmse").glob("c.*"))
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    store = open_store(copy)
    sweep = reduced_sweep(store, {"over": ["Td"], "max": ["nmse"]})
    with pytest.raises(SweepError, match="is not as it was written; `fic-sweep verify"):
        reduce_store(store, sweep, tmp_path / "r.zarr", None, lambda *_: None)


def test_a_reduced_store_says_what_it_is(reduced):
    lines = " ".join(messages.status_lines(reduced))
    assert re.search(
        r"reduced over Td, Denv.*: contact 2 x integrator 2 x K0 3 .*= \d+ cells", lines
    )
    assert re.search(r"values +nmse [\d.]+ % \(.* not trusted", lines)
    grid = reduced.grid
    assert f"= {grid.full.cells:,} scenarios of 60 steps" in messages.plan_lines(grid, "float32")[0]
    for name, variable in dataset(reduced.path).data_vars.items():
        assert variable.attrs["long_name"], name


def test_a_picture_hatches_what_is_refused_and_says_what_varied(reduced):
    data = dataset(reduced.path)
    at = {"contact": "welded", "integrator": "rk4"}
    plane = planes.select(data, x="K0", y="Kenv", metric="nmse_max", at=at)
    for key, code in {"diverged": DIVERGED, "not trusted": UNTRUSTED}.items():
        status = data["nmse_status"].sel(at)
        if "sigma" in status.dims:
            status = status.isel(sigma=1)
        np.testing.assert_array_equal(
            plane.special.get(key, False) * np.ones(plane.values.shape, bool),
            status.transpose("Kenv", "K0") == code,
        )
    assert plane.special
    assert "over 5 values of $D_{env}$ = 1 to 1000 N·m·s/rad" in plane.held
    with pytest.raises(PlotError, match="'nmse_status' is no metric: a picture"):
        planes.select(data, x="K0", y="Kenv", metric="nmse_status")


def test_the_plan_of_a_billion_needs_no_array_of_them():
    axes = "".join(f"{name} = {{ log = [1, 10], n = 100 }}\n" for name in ("Kenv", "Denv", "sigma"))
    text = f'name = "a"\n[axes]\nK0 = {{ log = [1, 10], n = 1000 }}\n{axes}'
    grid = Grid(parse(f'{text}[reduce]\nover = ["Denv", "sigma"]\nmax = ["nmse"]', "f"))
    assert (grid.full.cells, grid.cells, grid.combinations) == (10**9, 10**5, 10**4)
    assert cells_of(next(grid.blocks())) * grid.combinations <= LARGEST_BLOCK
    assert grid.n_blocks <= 2 * FEW_BLOCKS  # sides are halved
    assert list(itertools.islice(grid.blocks(), 2))
