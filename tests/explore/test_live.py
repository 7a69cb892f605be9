"""A live map has the numbers of `sweep`; so have its motion, its Python and its sweep file."""

from dataclasses import replace

import numpy as np
import pytest

from fic_jax import METRICS, Model, Params, histories, sweep
from fic_jax.params import QUANTITIES, check_field
from sweeps import LIBRARY, runner
from sweeps.explore import live
from sweeps.explore.cells import REASONS
from sweeps.explore.live import Live
from sweeps.explore.motion import MOST_SAMPLES, motion
from sweeps.explore.server import picture
from sweeps.explore.view import Range, ViewError, changed
from sweeps.spec.reading import load, parse
from sweeps.store.opening import dataset

SMALL = 9  # cells of a side


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(live, "COARSE", SMALL)
    monkeypatch.setattr(live, "FINE", SMALL)
    monkeypatch.setattr(live, "BAND", 20)  # a map of several bands


@pytest.fixture
def source():
    return Live()


def view_of(source, **values):
    """The first view with other values, 100 steps long."""
    view = source.start
    for name, value in {"t_end": 1.0, **values}.items():
        view = changed(view, name, str(value), source.space)
    return view


@pytest.mark.parametrize("integrator", ["rk4", "rk4_events"])
def test_a_map_is_a_sweep(source, integrator):
    view = view_of(source, Td=3.0, integrator=integrator, contact="welded")
    found = source.map(view, SMALL)
    K0, Kenv = np.meshgrid(found.y.values, found.x.values, indexing="ij")
    params = Params(
        **{
            name: np.float32(value)
            for name, value in vars(Params(K0=K0.ravel(), Kenv=Kenv.ravel(), Td=3.0)).items()
        }
    )
    model = Model(integrator=integrator, contact="welded")
    expected = sweep(params, model=model, dt=0.01, n_steps=100)
    for name, values in found.variables.items():
        if name in METRICS:
            np.testing.assert_array_equal(values.ravel(), getattr(expected, name))


@pytest.mark.parametrize("integrator", ["rk4", "rk4_events"])
@pytest.mark.parametrize("contact", ["hard_stop", "damped_rebound"])
def test_a_motion_is_that_of_its_cell_to_the_last_bit(source, integrator, contact):
    view = view_of(source, Denv=0.0, integrator=integrator, contact=contact)
    found = source.map(view, SMALL)
    for row, column in ((0, 0), (4, 7), (8, 8), (1, 6)):
        cell = (found.x.value(column), found.y.value(row))
        one = motion(source.scenario(view.place(cell)))
        for name in METRICS:
            if name in found.variables:
                assert getattr(one.metrics, name) == found.variables[name][row, column], name


def test_a_motion_has_the_signals_of_histories(source):
    view = view_of(source, gap=0.05, xd=0.05)
    scenario = source.scenario(view.place((200.0, 100.0)))
    one = motion(scenario).samples
    run = histories(scenario.params, model=scenario.model, dt=0.01, n_steps=100).isel(scenario=0)
    # another compiler: its rounding differs, and a joint that stops can take another branch
    for name in ("x", "v", "x_h", "tau_env", "torque"):
        np.testing.assert_allclose(getattr(one, name), run[name], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(one.t, run["time"], rtol=1e-6)


def test_a_long_motion_is_thinned_and_keeps_its_end(source):
    view = view_of(source, t_end=25.0)
    one = motion(source.scenario(view.place((200.0, 100.0))))
    assert len(one.samples.t) <= MOST_SAMPLES
    assert one.samples.t[-1] == np.float32(25.0)
    found = source.map(
        replace(view, ranges={"Kenv": Range(200, 300, "lin"), "K0": Range(100, 200, "lin")}), 2
    )
    assert one.metrics.nmse == found.values[0, 0]


def test_V_is_constant_on_a_branch_and_does_not_rise(source):
    """Without an environment and with a fixed reference the attractor conserves V."""
    free = {"Kenv": 0.0, "Denv": 0.0, "sigma": 0.0, "x_init": 0.02, "t_end": 2.0}
    one = motion(source.scenario(source.defaults | free))
    rounding = 1e-5 * one.V.max()  # of float32, over 200 steps
    converging = one.V[1 : np.flatnonzero(one.samples.diverging[1:])[0]]  # it starts at rest
    assert converging.size > 50
    assert np.ptp(converging) < rounding
    assert np.diff(one.V).max() < rounding


def test_the_copied_python_gives_the_same_numbers(source):
    view = view_of(source, Td=-4.0, contact="welded", law="effort")
    view = replace(view, metric="steady_error")
    names: dict = {}
    exec(source.python(view), names)
    # x64 is on in tests: its numbers are those of a map in float64
    expected = Live(dtype="float64").map(view, SMALL)
    np.testing.assert_array_equal(names["steady_error"], expected.values)


def test_the_copied_sweep_file_gives_the_same_numbers(source, tmp_path):
    view = view_of(source, Td=8.0, feedback="motor")
    plan = parse(source.sweep_file(view), "copied.toml")
    store = runner.start(tmp_path / "copied.zarr", plan, None, plan.bits)
    runner.run(store, lambda _: None)
    stored = dataset(tmp_path / "copied.zarr")
    found = source.map(view, SMALL)
    np.testing.assert_array_equal(stored["nmse"].transpose("K0", "Kenv"), found.values)
    assert "Td = 8.0" in source.sweep_file(view)
    assert "Kenv = {" in source.sweep_file(view)


def test_a_sweep_file_in_double_precision_says_so():
    source = Live(dtype="float64")
    assert "precision = 64" in source.sweep_file(source.start)
    assert "jax_enable_x64" in source.python(source.start)


@pytest.mark.parametrize("name", [path.stem for path in sorted(LIBRARY.glob("*.toml"))])
def test_each_sweep_of_the_library_begins_with_a_map(name):
    source = Live(load(LIBRARY / f"{name}.toml"))
    source.check(source.start)
    sweep = source.sweep
    assert {source.start.x, source.start.y} <= {*sweep.axes, *sweep.cases, "K0", "Kenv"}


@pytest.mark.parametrize("name", QUANTITIES)
def test_sliders_stay_within_the_bounds_of_the_field(name):
    ends = live.span(name)
    default = getattr(Params(), name)
    assert ends.low <= default <= ends.high
    check_field(name, [ends.low, ends.high])
    if live.includes_zero(name):
        check_field(name, 0.0)


@pytest.mark.parametrize("name", QUANTITIES)
def test_each_field_can_be_an_axis(source, name):
    view = source.with_axis(source.start, "x", name)
    if name in ("x0", "xb"):  # beyond the other one no profile exists: an address says it
        view = replace(
            view,
            ranges=view.ranges
            | {name: Range(0.05, 0.09, "lin") if name == "x0" else Range(0.2, 0.3, "lin")},
        )
    source.check(view)


def test_period_moves_by_plant_steps(source):
    assert source.moved(source.start, "period", 0.0234).at["period"] == 0.02
    assert source.moved(source.start, "dt", 0.004).at["period"] == pytest.approx(0.008)
    view = source.with_axis(source.start, "x", "period")
    values = source.map(changed(view, "t_end", "0.1", source.space), SMALL).x.values
    np.testing.assert_allclose(values / 0.01, np.rint(values / 0.01), atol=1e-9)


def test_two_equal_axes_change_places(source):
    view = source.with_axis(source.start, "x", source.start.y)
    assert (view.x, view.y) == (source.start.y, source.start.x)


def test_a_diverged_cell_has_a_reason_and_no_colour(source):
    view = view_of(source, Denv=1e6, contact="welded")
    found = source.map(view, SMALL)
    assert (found.reasons == REASONS.index("diverged")).all()
    assert found.shares == {"diverged": 1.0}
    one = motion(source.scenario(view.place((100.0, 100.0))))
    assert not one.metrics.finite


def test_the_estimate_marks_what_is_not_trusted(source):
    found = source.map(view_of(source, K0=1.0), SMALL, error_estimate=True)
    assert found.doubt.untrusted.shape == (SMALL, SMALL)


@pytest.mark.parametrize(
    ("values", "wanted"),
    [
        ({"x0": 0.2}, "`xb` must be greater than x0"),
        ({"Fmax": -1}, "`Fmax` must be positive"),
        ({"dt": 0.003}, "`t_end` must be a whole multiple of dt"),
        ({"dt": 1e-9}, "steps of dt"),
        ({"dt": 1e-6}, "at most 200,000 times `dt` in a live map, but is 1,000,000"),
        ({"x": "I"}, "must have `range.I` too"),
        ({"range.K0": "log:0:1"}, "between positive ends"),
        ({"range.K0": "lin:1:1"}, "two different ends"),
    ],
)
def test_what_can_not_be_computed_is_one_line(source, values, wanted):
    with pytest.raises(ViewError, match=wanted) as error:
        source.check(view_of(source, **values))
    assert "\n" not in str(error.value)


def test_a_stale_map_is_given_up(source):
    asked = []

    def stale():
        asked.append(1)
        return len(asked) > 2

    assert source.map(source.start, SMALL, stale) is None
    assert len(asked) == 3


def test_a_picture_of_a_map_is_drawn(source, strict):
    assert b"<svg" in picture(source, view_of(source), "svg")[:500]
