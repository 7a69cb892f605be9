"""Lines over one dimension, and dots for the scenarios of a random design."""

import json

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from figures import PlotError, plot, style
from figures.points import select
from tests import legible

K0 = np.geomspace(1.0, 1000.0, 7)
BOUND = {"bound": "max(1 % of nmse, 1e-12)"}


def along(**extra):
    """A sweep of one axis: one value not trusted, one diverged, one that never converges."""
    status, trust = np.ones(7, np.uint8), np.full(7, 2, np.uint8)
    status[5], trust[2] = 2, 1
    data = xr.Dataset(
        {
            "nmse": ("K0", np.geomspace(1e-4, 10, 7), {"long_name": "error", "units": "1"}),
            "convergence_time": ("K0", [1.0, 2, 3, 4, 5, 6, np.inf], {"units": "s"}),
            "nmse_trusted": ("K0", trust, BOUND),
            "status": ("K0", status),
        },
        {"K0": ("K0", K0, {"units": "N*m/rad"})},
        {"name": "line"} | extra,
    )
    data.nmse[5] = np.nan
    return data


def design(n=50):
    """A random design of two fields."""
    rng = np.random.default_rng(3)
    fields = {"K0": np.exp(rng.uniform(0, 7, n)), "Kenv": rng.uniform(10, 100, n)}
    status = np.ones(n, np.uint8)
    status[:3] = 2
    data = xr.Dataset(
        {"nmse": ("scenario", rng.uniform(0.001, 1, n)), "status": ("scenario", status)},
        {name: ("scenario", values) for name, values in fields.items()},
    )
    data["nmse"] = data.nmse.where(data.status == 1)
    return data


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for box in figure.legends for text in box.get_texts()]


def lines(figure: Figure) -> dict[str, np.ndarray]:
    """Marker, or line -> what it draws."""
    drawn = {line.get_marker() if line.get_ls() == "None" else "line": line.get_xydata()
             for line in figure.axes[0].lines if len(line.get_xdata()) != 2}  # fmt: skip
    return {key: np.ma.filled(points, np.nan) for key, points in drawn.items()}


def test_a_store_of_one_dimension_is_a_line_with_gaps():
    data = along()
    figure = plot(data)  # the only dimension need not be named
    axes = figure.axes[0]
    drawn = next(line for line in axes.lines if line.get_ls() == "-")
    np.testing.assert_array_equal(drawn.get_ydata(), data.nmse)
    np.testing.assert_array_equal(drawn.get_xdata(), K0)
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert axes.get_xlabel() == "$K_0$ (N·m/rad)" and axes.get_ylabel() == "error"


def test_an_untrusted_value_is_open_and_a_diverged_one_a_hatched_band():
    figure = plot(along())
    (open_,) = [line for line in figure.axes[0].lines if line.get_mfc() == "white"]
    assert open_.get_xdata().tolist() == [K0[2]]
    (band,) = figure.axes[0].patches
    assert band.get_hatch() == style.HATCHES["diverged"].pattern
    box = band.get_path().get_extents()
    assert [box.x0, box.x1] == pytest.approx(np.sqrt([K0[4] * K0[5], K0[5] * K0[6]]))
    assert legend(figure) == [
        "diverged (14 %)",
        "not trusted: error > max(1 % of nmse, 1e-12) (14 %)",
        "nmse = 0.01",
    ]


def test_what_never_converges_is_no_point_of_the_line():
    figure = plot(along(), metric="convergence_time")
    assert "never converges (14 %)" in legend(figure)
    assert figure.axes[0].get_ylim()[1] < 6


def test_no_value_lies_outside_the_axes():
    data = along()
    data.nmse[0] = 0.0  # a log scale has no place for it
    low, high = plot(data).axes[0].get_ylim()
    assert low <= 0.0 and high >= 10.0


@pytest.mark.parametrize("request_", [{}, {"x": "K0"}, {"x": "K0", "y": "Kenv"}])
def test_every_picture_can_be_read_in_a_column_and_in_grey(request_):
    legible.check(plot(design() if request_ else along(), **request_))


def test_a_plane_gives_a_line_at_a_cut():
    data = xr.concat([along(), along() * 2], xr.Variable("Td", [1.0, 5.0], {"units": "N*m"}))
    data["status"], data["nmse_trusted"] = xr.ones_like(data.nmse), 2 * xr.ones_like(data.nmse)
    figure = plot(data, x="K0", at={"Td": 5})
    assert "$T_d$ = 5 N·m" in figure.get_suptitle()
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_ydata(), 2 * along().nmse)


def test_scenarios_of_a_random_design_are_dots_over_a_field():
    data = design()
    figure = plot(data, x="K0")
    assert figure.axes[0].get_xscale() == "log"
    dots, diverged = lines(figure)["o"], lines(figure)["x"]
    assert np.isnan(dots[:3, 1]).all() and len(dots) == 50
    np.testing.assert_array_equal(dots[3:], np.stack([data.K0, data.nmse], 1)[3:])
    np.testing.assert_array_equal(diverged[:, 0], data.K0[:3])
    assert "diverged (6.0 %)" in legend(figure)


def test_two_fields_of_a_random_design_give_dots_coloured_by_the_metric():
    data = design()
    figure = plot(data, x="K0", y="Kenv")
    axes = figure.axes[0]
    (dots,) = [c for c in axes.collections if isinstance(c, PathCollection)]
    np.testing.assert_array_equal(dots.get_offsets(), np.stack([data.K0, data.Kenv], 1)[3:])
    np.testing.assert_array_equal(dots.get_array(), data.nmse[3:])
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "linear")
    assert lines(figure)["x"].tolist() == np.stack([data.K0, data.Kenv], 1)[:3].tolist()


def test_an_axis_of_a_random_design_has_the_scale_of_its_range():
    """Values of a narrow range say nothing of it; the sweep file does."""
    data = design()
    ranges = {"K0": {"lin": [1.0, 1100.0]}, "Kenv": {"log": [10.0, 100.0]}}
    data.attrs["sweep"] = json.dumps({"sample": {"ranges": ranges}})
    axes = plot(data, x="K0", y="Kenv").axes[0]
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({}, "Name the horizontal axis: `--x` one of K0, Kenv"),
        ({"x": "Td"}, "There is no dimension 'Td'"),
        ({"x": "K0", "y": "K0"}, "both are 'K0'"),
        ({"x": "K0", "metric": "nsme"}, "Did you mean 'nmse'"),
        ({"x": "K0", "at": {"scenario": 4}}, "drawn as an axis"),
        ({"x": "K0", "at": {"Kenv": 4}}, "'Kenv' varies along 'scenario'"),
    ],
)
def test_a_wrong_request_gets_one_clear_line(request_, message):
    with pytest.raises(PlotError, match=message) as caught:
        plot(design(), **request_)
    assert "\n" not in str(caught.value)


def test_what_varies_unseen_along_the_drawn_field_is_named():
    """A dot over K0 of a case has another Td too: no effect of K0 alone."""
    data = xr.Dataset(
        {"nmse": ("case", [0.1, 0.2, 0.3], {"long_name": "error", "units": "1"})},
        coords={
            "case": [0, 1, 2],
            "K0": ("case", [5.0, 10.0, 3.0], {"units": "N*m/rad"}),
            "Td": ("case", [1.0, 2.0, 3.0], {"units": "N*m"}),
            "gap": ("case", [0.0, 0.0, 0.0], {"units": "rad"}),
        },
    )
    held = select(data, x="K0", y=None, metric="nmse").held
    assert [text for text in held if "varying" in text] == ["varying too: $T_d$ = 1 to 3 N·m"]
