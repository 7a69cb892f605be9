"""A map of a store has the store's numbers, cut or reduced; a running sweep fills in."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from sweeps import runner
from sweeps.explore.cells import REASONS
from sweeps.explore.motion import motion
from sweeps.explore.stored import Stored
from sweeps.explore.view import changed, parse
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse as read
from sweeps.store.opening import dataset, open_store
from tests.explore.conftest import CUBE, ran

REFINED = """
name = "refined"
[time]
t_end = 0.5
[axes]
K0 = { log = [1.0, 100.0], n = 3 }
Kenv = { log = [10.0, 100.0], n = 3 }
[refine]
levels = 3
classes = ["nmse < 1.5"]
"""


@pytest.fixture
def source(cube):
    return Stored(cube)


@pytest.fixture
def data(cube):
    return dataset(cube).load().sortby("Kenv")


def test_the_first_map_is_the_middle_of_a_store(source, data):
    view = source.start
    assert (view.metric, view.y, view.x) == ("nmse", "K0", "Kenv")
    found = source.map(view)
    expected = data["nmse"].sel(contact=view.at["contact"], Td=5.0)
    np.testing.assert_array_equal(found.values, expected.transpose("K0", "Kenv"))
    np.testing.assert_array_equal(found.x.values, data["Kenv"])


def test_any_two_dimensions_can_be_the_axes(source, data):
    view = source.with_axis(source.start, "x", "contact")
    view = source.with_axis(view, "y", "Td")
    found = source.map(view)
    expected = data["nmse"].isel(K0=2, Kenv=2).transpose("Td", "contact")
    assert float(data["K0"][2]) == view.at["K0"]
    assert float(data["Kenv"][2]) == view.at["Kenv"]
    np.testing.assert_array_equal(found.values, expected)
    assert found.x.ticks()[0][1] == "hard stop"


def test_what_is_not_trusted_is_marked(source, data):
    found = source.map(source.start)
    cut = data["nmse_trusted"].sel(contact=source.start.at["contact"], Td=5.0)
    np.testing.assert_array_equal(found.doubt.untrusted, cut.transpose("K0", "Kenv") == 1)


REDUCED = {
    "worst": lambda cells: cells.max(["contact", "Td"]),
    "mean": lambda cells: cells.mean(["contact", "Td"]),
    "median": lambda cells: cells.median(["contact", "Td"]),
    "share": lambda cells: (cells <= 0.3).mean(["contact", "Td"]),
}


@pytest.mark.parametrize("how", REDUCED)
def test_the_rest_can_be_reduced(source, data, how):
    view = replace(source.start, over=("Td", "contact"), how=how, level=0.3)
    found = source.map(view)
    expected = REDUCED[how](data["nmse"]).transpose("K0", "Kenv")
    np.testing.assert_allclose(found.values, expected, rtol=1e-6)  # order of the sum
    untrusted = (data["nmse_trusted"] == 1).any(["contact", "Td"]).transpose("K0", "Kenv")
    np.testing.assert_array_equal(found.doubt.untrusted, untrusted)


def test_the_worst_of_a_signed_metric_is_farthest_from_zero(source, data):
    view = replace(source.start, metric="steady_error", over=("Td",))
    cells = data["steady_error"].sel(contact=view.at["contact"])
    expected = cells.isel(abs(cells).argmax(["Td"])).transpose("K0", "Kenv")
    np.testing.assert_array_equal(source.map(view).values, expected)


@pytest.mark.parametrize("over", [(), ("Td",), ("contact", "Td")])
@pytest.mark.parametrize("how", REDUCED)
def test_the_copied_python_gives_the_same_numbers(source, over, how):
    view = replace(source.start, over=over, how=how, level=0.3)
    names: dict = {}
    exec(source.python(view), names)
    found = names["nmse"].sortby("Kenv")
    np.testing.assert_allclose(found, source.map(view).values, rtol=1e-6)


def test_the_copied_python_of_a_signed_metric(source):
    view = replace(source.start, metric="steady_error", over=("Td", "contact"))
    names: dict = {}
    exec(source.python(view), names)
    found = names["steady_error"].sortby("Kenv")
    np.testing.assert_array_equal(found, source.map(view).values)


VARIABLE = {"worst": "nmse_max", "mean": "nmse_mean", "median": "nmse_q50", "share": "within_share"}


@pytest.mark.parametrize("how", ["", *REDUCED])
def test_the_copied_sweep_file_gives_the_same_numbers(source, tmp_path, how):
    view = replace(source.start, over=("Td",) if how else (), how=how or "worst", level=0.3)
    stored = xr.open_zarr(ran(tmp_path / "again.zarr", source.sweep_file(view)), chunks=None)
    again = stored[VARIABLE.get(how, "nmse")].sortby("Kenv").transpose("K0", "Kenv")
    found = source.map(view)
    # a reduced store refuses what rests on cells that are not trusted
    known = (
        np.isfinite(again.values) if how in ("worst", "mean", "median") else np.ones((5, 4), bool)
    )
    np.testing.assert_allclose(again.values[known], found.values[known], rtol=1e-6)
    assert known.any()


def test_a_motion_has_the_numbers_of_its_cell(source, data):
    view = source.start
    for K0, Kenv, contact in ((10.0, 100.0, "welded"), (1000.0, 10.0, "hard_stop")):
        place = view.at | {"K0": K0, "Kenv": Kenv, "contact": contact}
        one = motion(source.scenario(place))
        cell = data.sel(K0=K0, Kenv=Kenv, contact=contact, Td=5.0)
        assert one.metrics.nmse == cell["nmse"].item()
        assert one.nmse == pytest.approx(cell["nmse"].item(), rel=0.01)  # of the signals
        assert one.note == ""
        assert "nmse = 0.5" in replace(one, nmse=0.5).note
        rows = source.values(place, {})
        assert float(rows[0][3]) == cell["nmse"].item()
        assert source.disagreement(place, rows, {"nmse": float(one.metrics.nmse)}) == ""
        assert "another version" in source.disagreement(place, rows, {"nmse": 0.5})


@pytest.mark.parametrize("metric", ["nmse", "steady_error"])
def test_the_motion_of_a_worst_case_is_that_of_the_worst_cell(source, metric):
    view = replace(source.start, metric=metric, over=("Td", "contact"), cell=(10.0, 1000.0))
    found = source.map(view)
    place = source.place(view)
    one = motion(source.scenario(place))
    assert getattr(one.metrics, metric) == found.values[4, 0]
    assert place["K0"] == 1000.0
    median = replace(view, how="median")
    assert source.place(median) == median.place()


def test_an_address_of_a_store_is_a_view_of_it(source):
    view = replace(source.start, over=("Td",), how="median", cell=(10.0, 1000.0))
    view = view.pinned(view.place())
    assert parse(view.query(source.defaults), source.start, source.space, source.defaults) == view


def test_a_link_off_the_grid_shows_the_nearest_values_that_were_run(source):
    view = replace(source.start, at=source.start.at | {"Td": 4.0}, cell=(33.0, 120.0))
    opened = source.opened(view)
    assert opened.at["Td"] == 5.0
    x, y = opened.cell
    assert x in source.coordinates[view.x] and y in source.coordinates[view.y]


def test_a_cell_that_was_not_simulated_says_so(tmp_path):
    refined = Stored(ran(tmp_path / "refined.zarr", REFINED))
    status = xr.open_zarr(tmp_path / "refined.zarr", chunks=None)["status"]
    for code, said in ((1, "another version"), (5, "was not simulated")):
        i, j = np.argwhere(status.values == code)[0]
        place = {"K0": float(status["K0"][i]), "Kenv": float(status["Kenv"][j])}
        note = refined.disagreement(place, refined.values(place, {}), {"nmse": 0.5})
        assert said in note


def test_a_slider_takes_the_nearest_value_that_was_run(source):
    assert source.moved(source.start, "Td", 4.0).at["Td"] == 5.0
    assert changed(source.start, "contact", "welded", source.space).at["contact"] == "welded"


def test_a_running_sweep_fills_in(tmp_path):
    path = ran(tmp_path / "cube.zarr", CUBE, chunk=12, blocks=[0, 1])
    source = Stored(path)
    assert source.running
    view = replace(source.start, at=source.start.at | {"contact": "hard_stop"})
    before = source.map(view)
    assert set(np.unique(before.reasons)) == {0, REASONS.index("not run")}
    known = before.reasons == 0
    version = source.version
    runner.run(open_store(path), lambda _: None)
    source._next_poll = 0.0
    source.poll()
    assert source.version > version
    assert not source.running
    after = source.map(view)
    assert not after.reasons.any()
    np.testing.assert_array_equal(after.values[known], before.values[known])
    worst = source.map(replace(view, over=("Td",)))
    assert not worst.reasons.any()


def test_a_statistic_of_cells_that_were_not_run_is_not_one(tmp_path):
    source = Stored(ran(tmp_path / "cube.zarr", CUBE, chunk=12, blocks=[0]))
    found = source.map(replace(source.start, over=("Td", "contact")))
    assert (found.reasons == REASONS.index("not run")).all()


def test_a_large_store_is_read_slice_by_slice(source, data, monkeypatch):
    monkeypatch.setattr("sweeps.explore.stored.MOST_HELD", 10)
    large = Stored(source.path)
    assert large.space.reducible == ()
    np.testing.assert_array_equal(large.map(large.start).values, source.map(source.start).values)
    assert not large._variables


def test_blocks_are_loaded_before_a_slider_needs_them(cube):
    source = Stored(cube)
    (_, show), (_, load) = source.stages()
    show(source.start, None, lambda: False)
    assert len(source._variables["nmse"].loaded) < len(source._done)
    load(source.start, None, lambda: True)  # a newer view waits
    assert len(source._variables["nmse"].loaded) < len(source._done)
    load(source.start, None, lambda: False)
    for name in ("nmse", "nmse_trusted", "status", "convergence_time"):
        assert len(source._variables[name].loaded) == len(source._done)


def test_a_random_design_is_refused_with_what_draws_it(tmp_path):
    text = (
        'name = "s"\n[time]\nt_end = 0.1\n[sample]\nn = 8\nranges = { K0 = { log = [1.0, 9.0] } }\n'
    )
    path = ran(tmp_path / "s.zarr", text)
    with pytest.raises(SweepError, match=r"no axes; `fic-sweep plot \S+s.zarr --x K0 --y \w+`"):
        Stored(path)


def test_one_dimension_is_refused_with_what_draws_it(tmp_path):
    path = ran(tmp_path / "s.zarr", 'name = "s"\n[time]\nt_end = 0.1\n[axes]\nK0 = [1.0, 2.0]\n')
    with pytest.raises(SweepError, match=r"a map needs two; `fic-sweep plot \S+s.zarr --x K0`"):
        Stored(path)


def test_a_reduced_store_shows_its_answers_and_has_no_motion(tmp_path):
    text = CUBE + '[reduce]\nover = ["Td"]\nmax = ["nmse"]\nuntrusted = 0.5\n'
    source = Stored(ran(tmp_path / "r.zarr", text))
    assert not source.has_motion
    assert "nmse_max" in source.space.metrics
    found = source.map(replace(source.start, metric="nmse_max"))
    stored = (
        xr.open_zarr(source.path, chunks=None)
        .sortby("Kenv")
        .sel(contact=source.start.at["contact"])
    )
    np.testing.assert_array_equal(found.values, stored["nmse_max"].transpose("K0", "Kenv"))
    assert source.values(source.start.at, {})[0][0] == source.space.metrics[0]


def test_cases_are_a_dimension(tmp_path):
    text = (
        'name = "c"\n[time]\nt_end = 0.2\n[axes]\nK0 = [10.0, 100.0, 1000.0]\n'
        "[cases]\nDenv = [0.0, 63.2]\ngap = [0.0, 0.5]\n"
    )
    source = Stored(ran(tmp_path / "c.zarr", text))
    found = source.map(source.start)
    assert (found.y.name, found.x.name) == ("K0", "case")
    one = motion(source.scenario(source.start.at | {"case": 1.0}))
    assert float(one.scenario.params.gap) == np.float32(0.5)
    plan = read(source.sweep_file(source.start), "copied")
    assert plan.cases == source.grid.sweep.cases


def test_a_picture_can_be_saved_of_each_kind_of_view(source):
    from sweeps.explore.server import picture

    for view in (source.start, replace(source.start, over=("Td",), how="worst")):
        assert b"<svg" in picture(source, view, "svg")[:500]
    assert picture(source, source.start, "png").startswith(b"\x89PNG")
