"""A heatmap shows the selected plane with its labels; a cell without a value gets no colour."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure

from fic_jax import QUANTITIES
from figures import PlotError, panels, plot, save, select, style
from sweeps.plan.grid import Grid
from sweeps.spec.reading import parse
from sweeps.spec.types import Sweep
from sweeps.store import format as store_format
from tests import legible

PLAN = parse('name = "small"\n[axes]\nK0 = [1.0, 2.0]', "small.toml")

UNITS = {"K0": "N*m/rad", "Kenv": "N*m/rad", "Td": "N*m", "period": "s", "Denv": "N*m*s/rad"}


RECORD = {
    "constants": {"sigma": 0.02, "Denv": 63.2},
    "model": {"contact": "hard_stop", "integrator": "rk4_events"},
    "time": {"dt": 0.001, "t_end": 10.0},
}


def says(data: xr.Dataset, record: dict[str, Any] = RECORD) -> dict[str, str]:
    """The attributes of a store of such a sweep over the axes of `data`."""
    axes = {str(name): [1.0] for name in data.coords if name in QUANTITIES}
    sweep = Sweep.model_validate({"name": "test", "axes": axes} | record)
    said = store_format.attributes(Grid(sweep))
    return {name: said[name] for name in ("held", "held_by_default")}


def dataset(**axes):
    """A sweep whose cells all differ, so that a wrong or transposed plane is noticed."""
    shape = tuple(len(values) for values in axes.values())
    coords = {
        name: (name, np.asarray(values), {"units": UNITS.get(name, "1")})
        for name, values in axes.items()
    }
    ramp = (np.arange(np.prod(shape), dtype=float) + 1).reshape(shape)
    variables = {
        "nmse": (1e-5 * ramp, "normalised mean square error", "1"),
        "convergence_time": (0.1 * ramp, "convergence time", "s"),
        "steady_error": (0.01 * ramp - 0.05, "steady error", "1"),
    }
    data = xr.Dataset(
        {
            key: (tuple(axes), values, {"long_name": long_name, "units": units})
            for key, (values, long_name, units) in variables.items()
        },
        coords=coords,
        attrs={"name": "small-sweep"},
    )
    data["status"] = (tuple(axes), np.ones(shape, dtype=np.uint8))
    return data


@pytest.fixture
def paper():
    return dataset(
        contact=["welded", "hard_stop"], K0=[0.1, 1.0, 10.0, 100.0, 1000.0], Td=[1.0, 5, 10, 20]
    )


@pytest.fixture
def atlas():
    return dataset(
        Td=[1.0, 5.0, 20.0], K0=np.geomspace(1, 1000, 16), Kenv=np.linspace(10, 1000, 12)
    )


def panel(figure: Figure) -> Axes:
    return figure.axes[0]


def mesh(axes: Axes) -> QuadMesh:
    return next(item for item in axes.collections if isinstance(item, QuadMesh))


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for box in figure.legends for text in box.get_texts()]


def title(figure: Figure) -> str:
    return figure.get_suptitle()


def test_the_selected_plane_is_drawn_with_x_horizontal(paper):
    figure = plot(paper, x="Td", y="K0", at={"contact": "welded"})
    np.testing.assert_array_equal(mesh(panel(figure)).get_array(), paper.nmse.values[0])
    turned = plot(paper, x="K0", y="Td", at={"contact": "hard_stop"})
    np.testing.assert_array_equal(mesh(panel(turned)).get_array(), paper.nmse.values[1].T)
    assert panel(turned).get_xlabel() == "$K_0$ (N·m/rad)"


def test_unordered_values_are_drawn_in_order(paper):
    shuffled = paper.isel(contact=0, Td=[2, 0, 3, 1])
    figure = plot(shuffled, x="Td", y="K0")
    np.testing.assert_array_equal(mesh(panel(figure)).get_array(), paper.nmse.values[0])


def test_at_takes_the_nearest_value_and_the_title_has_it(atlas):
    figure = plot(atlas, x="K0", y="Kenv", at={"Td": 6.0})
    np.testing.assert_array_equal(mesh(panel(figure)).get_array(), atlas.nmse.values[1].T)
    assert title(figure) == "small-sweep\n$T_d$ = 5 N·m"


def test_another_dimension_is_fixed_at_its_middle_and_the_title_has_it(paper):
    figure = plot(paper, x="Td", y="contact")
    np.testing.assert_array_equal(mesh(panel(figure)).get_array(), paper.nmse.values[:, 2])
    assert "$K_0$ = 10 N·m/rad" in title(figure)


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        (np.geomspace(1, 1000, 9), "log"),
        (np.linspace(1, 1000, 9), "log"),  # three decades
        (np.linspace(10, 200, 9), "linear"),
        (np.geomspace(10, 200, 9), "log"),
        ([1.0, 5.0, 10.0, 20.0], "linear"),
        ([50.0, 100.0, 500.0], "log"),
        ([0.0, 63.2, 189.7], "linear"),
    ],
)
def test_axis_scale_follows_the_spacing(values, scale):
    assert panel(plot(dataset(K0=values, Td=[1.0, 2.0]), x="K0", y="Td")).get_xscale() == scale


def test_limits_are_the_outer_cell_edges(atlas):
    axes = panel(plot(atlas, x="K0", y="Kenv"))
    half = 10 ** (3 / 15 / 2)  # half a cell of 15 steps over three decades
    assert axes.get_xlim() == pytest.approx((1 / half, 1000 * half))
    narrow = panel(plot(dataset(K0=[20.0, 30, 40], Td=[2.0, 6.0, 14.0]), x="Td", y="K0"))
    assert narrow.get_ylim() == pytest.approx((15, 45))


def test_irregular_cells_meet_midway_in_their_own_scale():
    data = dataset(period=[0.001, 0.002, 0.01, 0.1], Denv=[0.0, 50.0, 200.0])
    corners = mesh(panel(plot(data, x="period", y="Denv"))).get_coordinates()
    inner = np.sqrt([0.001 * 0.002, 0.002 * 0.01, 0.01 * 0.1])
    np.testing.assert_allclose(corners[0, 1:-1, 0], inner)
    np.testing.assert_allclose(corners[:, 0, 1], [-25, 25, 125, 275])


def test_short_axes_are_ticked_at_their_values_and_cells_carry_numbers(paper):
    axes = panel(plot(paper.isel(contact=0), x="Td", y="K0"))
    assert [text.get_text() for text in axes.get_xticklabels()] == ["1", "5", "10", "20"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["0.1", "1", "10", "100", "1000"]
    assert len(axes.texts) == 20
    assert axes.texts[0].get_text() == "1e-5"


@pytest.mark.parametrize("place", [0, -1])
def test_cell_numbers_contrast_with_their_cell(paper, place):
    axes = panel(plot(paper.isel(contact=0), x="Td", y="K0"))
    colour = mesh(axes).to_rgba(mesh(axes).get_array()).reshape(-1, 4)[place, :3]
    weights = [0.299, 0.587, 0.114]
    ink = np.dot(to_rgb(axes.texts[place].get_color()), weights)
    assert abs(np.dot(colour, weights) - ink) > 0.45


def test_strings_and_whole_numbers_are_categories(paper):
    axes = panel(plot(paper, x="contact", y="Td"))
    assert [text.get_text() for text in axes.get_xticklabels()] == ["welded", "hard stop"]
    cases = panel(plot(dataset(case=[3, 7, 40], Td=[1.0, 2.0]), x="case", y="Td"))
    assert cases.get_xlim() == (-0.5, 2.5)
    assert [text.get_text() for text in cases.get_xticklabels()] == ["3", "7", "40"]


def test_nmse_has_a_logarithmic_scale_of_whole_decades_and_a_colour_for_zero(paper):
    paper.nmse[0, 0, 0] = 0.0
    quads = mesh(panel(plot(paper, x="Td", y="K0", at={"contact": "welded"})))
    assert isinstance(quads.norm, LogNorm)
    assert (quads.norm.vmin, quads.norm.vmax) == pytest.approx((1e-5, 1e-3))
    assert not np.ma.getmaskarray(quads.get_array()).any()
    np.testing.assert_allclose(quads.to_rgba(quads.get_array())[0, 0], quads.cmap(0))


def test_signed_error_is_centred_on_zero(paper):
    norm = mesh(panel(plot(paper, x="Td", y="K0", metric="steady_error"))).norm
    assert norm.vmin == -norm.vmax
    assert norm(0.0) == 0.5


def test_an_outlier_does_not_stretch_the_scale_and_the_colour_bar_gets_an_arrow(atlas):
    atlas.nmse[1, 0, 0] = 1e9
    figure = plot(atlas, x="K0", y="Kenv", at={"Td": 5})
    quads = mesh(panel(figure))
    assert quads.norm.vmax < 1
    assert quads.colorbar.extend == "max"


def test_cells_without_a_value_are_masked_hatched_and_named(atlas):
    time, status = atlas.convergence_time, atlas.status
    time[1, :4, :] = np.inf
    for row, code in ((4, 0), (5, 2), (6, 3)):
        status[1, row] = code
        time[1, row] = np.nan
    time[1, 7, 0] = np.nan
    figure = plot(atlas, x="Kenv", y="K0", metric="convergence_time", at={"Td": 5})
    hidden = np.ma.getmaskarray(mesh(panel(figure)).get_array())
    expected = np.zeros((16, 12), dtype=bool)
    expected[:7] = True
    expected[7, 0] = True
    np.testing.assert_array_equal(hidden, expected)
    assert legend(figure) == [
        "not run yet (6.2 %)",
        "diverged (6.2 %)",
        "failed (6.2 %)",
        "never converges (25 %)",
        "no value (0.5 %)",
    ]
    assert len({patch.get_hatch() for patch in panel(figure).patches}) == 5


def test_the_hatch_covers_exactly_the_cells_of_its_kind(atlas):
    atlas.status[1, 2:5, 3] = 2
    figure = plot(atlas, x="Kenv", y="K0", at={"Td": 5})
    (patch,) = panel(figure).patches
    corners = mesh(panel(figure)).get_coordinates()
    box = patch.get_path().get_extents()
    np.testing.assert_allclose([box.x0, box.y0], corners[2, 3])
    np.testing.assert_allclose([box.x1, box.y1], corners[5, 4])


def test_a_status_decoded_as_nan_means_not_run(atlas):
    data = atlas.assign(status=atlas.status.where(atlas.K0 > 2))
    assert legend(plot(data, x="Kenv", y="K0"))[0].startswith("not run yet")


def test_a_store_without_finished_cells_gets_no_colour_bar(atlas):
    atlas.status[:] = 0
    figure = plot(atlas, x="Kenv", y="K0")
    assert len(figure.axes) == 1
    assert legend(figure) == ["not run yet (100 %)"]


def test_a_plane_with_all_values_has_no_legend(atlas):
    assert legend(plot(atlas, x="Kenv", y="K0")) == []


def test_labels_name_quantity_and_unit(atlas):
    figure = plot(atlas, x="Kenv", y="K0", metric="convergence_time")
    assert panel(figure).get_xlabel() == "$K_{env}$ (N·m/rad)"
    assert figure.axes[1].get_ylabel() == "convergence time (s)"
    assert plot(atlas, x="Kenv", y="K0").axes[1].get_ylabel() == "normalised mean square error"


def test_panels_share_their_scale_and_the_title_has_what_they_share(atlas):
    row = [("", select(atlas, x="Kenv", y="K0", at={"Td": value})) for value in (1, 20)]
    figure = panels(row)
    left, right, _ = figure.axes
    assert (mesh(left).norm.vmin, mesh(left).norm.vmax) == (
        mesh(right).norm.vmin,
        mesh(right).norm.vmax,
    )
    assert mesh(right).norm.vmax >= atlas.nmse.values[2].max() * 0.99
    assert (left.get_title(), right.get_title()) == ("$T_d$ = 1 N·m", "$T_d$ = 20 N·m")
    assert title(figure) == "small-sweep"


def test_panels_of_different_metrics_are_refused(atlas):
    row = [("", select(atlas, x="Kenv", y="K0", metric=m)) for m in ("nmse", "steady_error")]
    with pytest.raises(PlotError, match="metrics differ: nmse, steady_error"):
        panels(row)


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"metric": "nsme"}, "no metric 'nsme'. Did you mean 'nmse'.*There are: nmse, conv"),
        ({"metric": "status"}, "'status' is no metric"),
        ({"at": {"Fmax": 5}}, "'Fmax' does not vary here: it is 15 N[*]m. There are: Td, K0"),
        ({"x": "contact"}, "'contact' does not vary here: it is hard_stop. There are: Td, K0"),
        ({"x": "kenv"}, "no dimension 'kenv'. Did you mean 'Kenv'.*There are: Td, K0, Kenv"),
        ({"y": "Kenv"}, "both are 'Kenv'"),
        ({"at": {"K0": 5}}, "'K0' is drawn as an axis; `at` cannot fix it too"),
        ({"at": {"TD": 5}}, "no dimension 'TD'. Did you mean 'Td'"),
        ({"at": {"Td": "five"}}, "Td is numeric, but `at` names 'five'"),
        ({"at": {"Td": "nan"}}, "Td is numeric"),
        ({"at": {"Td": 90}}, "Td = 90 lies outside the sweep, which covers 1 to 20 N·m"),
    ],
)
def test_a_wrong_request_gets_one_clear_line(atlas, request_, message):
    atlas.attrs |= says(atlas)
    with pytest.raises(PlotError, match=message) as caught:
        plot(atlas, **({"x": "Kenv", "y": "K0"} | request_))
    assert "\n" not in str(caught.value)


def test_a_wrong_model_choice_is_refused(paper):
    with pytest.raises(PlotError, match=r"no value of contact 'weldd'. Did you mean 'welded'"):
        plot(paper, x="Td", y="K0", at={"contact": "weldd"})


def test_at_may_be_half_a_cell_beyond_the_axis(atlas):
    assert "$T_d$ = 20" in title(plot(atlas, x="Kenv", y="K0", at={"Td": "35"}))


@pytest.mark.parametrize("cmap", [colormaps[style.SEQUENTIAL], style.DIVERGING])
def test_colour_maps_stay_ordered_in_a_grey_print(cmap):
    linear = cmap(np.linspace(0, 1, 256))[:, :3] ** 2.2
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(luminance) > 0)


@pytest.mark.parametrize("digits", [1, 2])
@pytest.mark.parametrize("value", [0.0, 1.2e-5, -0.034, 0.5, 7.0, 123.0, 9999.0, 3.4e7])
def test_numbers_in_cells_keep_their_value(value, digits):
    printed = float(style.cell_number(value, digits).replace("−", "-"))
    assert printed == pytest.approx(value, rel=0.5 * 10 ** (1 - digits))


def test_nothing_in_the_figure_is_cut_off(paper):
    paper.attrs["name"] = "a-sweep-whose-name-is-much-longer-than-one-column-of-a-printed-page"
    figure = plot(paper, x="Td", y="K0")
    FigureCanvasAgg(figure).draw()
    drawn, sheet = figure.get_tightbbox(), figure.bbox_inches
    assert drawn.x0 >= 0 and drawn.x1 <= sheet.x1
    assert drawn.y0 >= 0 and drawn.y1 <= sheet.y1


def test_every_heatmap_can_be_read_in_a_column_and_in_grey(paper):
    paper.attrs |= says(paper)
    legible.check(plot(paper, x="Td", y="K0"))
    legible.check(plot(paper, x="contact", y="Td"))


def test_a_legend_fits_the_width_of_the_figure(judged):
    """A bound with a floor is long; the reasons for masked cells stand under it, not beside it."""
    judged.status[1, 15, :] = 2
    figure = plot(judged, x="Kenv", y="K0", at={"Td": 5})
    FigureCanvasAgg(figure).draw()
    (box,) = figure.legends
    drawn = box.get_window_extent()
    assert drawn.x0 >= 0 and drawn.x1 <= figure.bbox.x1
    assert drawn.y0 >= 0 and drawn.y1 <= panel(figure).get_tightbbox().y0


def test_drawing_makes_no_pyplot_figure_and_changes_no_data(paper):
    before = paper.copy(deep=True)
    plot(paper, x="Td", y="K0")
    assert plt.get_fignums() == []
    xr.testing.assert_identical(paper, before)


def test_drawing_reads_only_a_plane_of_a_store(tmp_path, atlas):
    atlas.to_zarr(tmp_path / "atlas.zarr", consolidated=False)
    stored = xr.open_zarr(tmp_path / "atlas.zarr", consolidated=False, chunks=None)
    figure = plot(stored, x="Kenv", y="K0", at={"Td": 5})
    np.testing.assert_array_equal(mesh(panel(figure)).get_array(), atlas.nmse.values[1])
    assert not stored.nmse.variable._in_memory


def test_the_same_figure_is_saved_as_the_same_bytes(tmp_path, paper):
    for name in ("one.png", "two.png"):
        save(plot(paper, x="Td", y="K0"), tmp_path / name)
    first = (tmp_path / "one.png").read_bytes()
    assert first == (tmp_path / "two.png").read_bytes()
    assert b"Software" not in first


def held(figure: Figure) -> str:
    (box,) = figure.legends
    return box.get_title().get_text().replace("\n", " ")


def test_a_picture_states_all_that_the_sweep_holds_constant(atlas):
    """What nobody named too: a reader can't know that Fmax is 15, or that the period is 10 ms."""
    atlas.attrs |= says(atlas) | {"description": "An atlas of a few cells"}
    figure = plot(atlas, x="Kenv", y="K0")
    shown, default = held(figure).split("by default ")
    for text in (r"$\sigma$ = 0.02", "$D_{env}$ = 63.2 N·m·s/rad", "dt = 0.001 s", "t_end = 10 s"):
        assert text in shown
    for text in ("$F_{Max}$ = 15 N·m", "$I$ = 10 kg·m²", "control period = 0.01 s", "gap, "):
        assert text in default
    assert "$K_0$" not in held(figure) and "$T_d$" not in held(figure)  # drawn, and in the title
    assert title(figure).splitlines() == ["An atlas of a few cells", "hard stop, $T_d$ = 5 N·m"]


def test_panels_hold_what_all_share_and_each_title_has_its_own(atlas):
    other = RECORD | {"constants": {"sigma": 0.01, "Denv": 63.2}}
    sweeps = [atlas.assign_attrs(says(atlas, record)) for record in (RECORD, other)]
    figure = panels([("", select(data, x="Kenv", y="K0")) for data in sweeps])
    titles = [axes.get_title() for axes in figure.axes[:2]]
    assert titles == [r"$\sigma$ = 0.02", r"$\sigma$ = 0.01"]
    assert r"\sigma" not in held(figure) and "$F_{Max}$ = 15" in held(figure)


@pytest.mark.parametrize("n", [3, 41])
def test_ticks_and_titles_tell_neighbours_apart(n):
    """K0 from 1000 to 1000.5 had ticks 1000, 1000, 1000 and a cut at 1000.25 the title 1000."""
    data = dataset(K0=np.linspace(1000, 1000.5, n), Kenv=[50.0, 100.0], Td=[1.0, 5.0])
    axes = panel(plot(data, x="Kenv", y="K0"))
    for drawn in (axes, panel(plot(data, x="K0", y="Kenv"))):
        side = drawn.xaxis if drawn is not axes else drawn.yaxis
        labels = [text.get_text() for text in side.get_ticklabels() if text.get_text()]
        assert len(set(labels)) == len(labels) > 1
        assert [float(label) for label in labels] == pytest.approx(
            [place for place in side.get_ticklocs() if 1000 <= place <= 1000.5], abs=1e-9
        )
    assert "$K_0$ = 1000.25 N" in title(plot(data, x="Kenv", y="Td", at={"K0": 1000.25}))


def test_a_log_axis_of_less_than_a_decade_has_ticks():
    data = dataset(K0=np.geomspace(2.1, 4.7, 9), Td=[1.0, 5.0])
    assert len(panel(plot(data, x="K0", y="Td")).get_xticks()) > 1


def borders(axes: Axes) -> np.ndarray:
    return next(c for c in axes.collections if isinstance(c, LineCollection)).get_segments()


def test_a_line_parts_the_cells_on_either_side_of_nmse_001(atlas):
    atlas.nmse[1] = np.where(np.add.outer(np.arange(16), np.arange(12)) < 9, 0.004, 0.02)
    atlas.nmse[1, 0, 0] = 0.01
    atlas.status[1, 8, 0] = 2  # diverged: no value, and so no side of it is a border
    figure = plot(atlas, x="Kenv", y="K0", at={"Td": 5})
    assert "nmse = 0.01" in legend(figure)
    corners = mesh(panel(figure)).get_coordinates()
    ends = {tuple(np.round(point, 6)) for side in borders(panel(figure)) for point in side}
    assert tuple(np.round(corners[8, 1], 6)) in ends  # between (K0 7, Kenv 1) and (8, 1)
    assert len(borders(panel(figure))) == 2 * 9 - 1 - 1  # a staircase, less the diverged cell's
    assert [line.get_ydata()[0] for line in figure.axes[1].lines] == [0.01]


def test_a_line_parts_what_converges_from_what_does_not(atlas):
    atlas.convergence_time[1, :4] = np.inf
    figure = plot(atlas, x="Kenv", y="K0", metric="convergence_time", at={"Td": 5})
    corners = mesh(panel(figure)).get_coordinates()
    assert np.unique(np.array(borders(panel(figure)))[..., 1]) == pytest.approx(corners[4, 0, 1])
    assert legend(figure)[-1] == "converged or not"


def test_a_plane_on_one_side_of_the_border_has_no_line(atlas):
    figure = plot(atlas, x="Kenv", y="K0")
    assert not any(isinstance(c, LineCollection) for c in panel(figure).collections)


def test_a_constant_plane_gets_a_scale_around_its_value(atlas):
    atlas["convergence_time"][:] = np.float32(9.999999776e-3)
    norm = mesh(panel(plot(atlas, x="Kenv", y="K0", metric="convergence_time"))).norm
    assert 0.005 < norm.vmin < 0.01 < norm.vmax < 0.02


def test_a_field_along_another_dimension_is_refused(atlas):
    drawn = atlas.isel(Td=0, drop=True).assign_coords(gap=("K0", np.arange(16.0)))
    with pytest.raises(PlotError, match="'gap' varies along 'K0', which has no grid to draw on"):
        plot(drawn, x="gap", y="Kenv")


@pytest.fixture
def judged(atlas):
    """The atlas with error estimates; nmse is not trusted in half of the middle plane."""
    doubt = np.ones(atlas.nmse.shape, bool)
    doubt[1] = np.add.outer(np.arange(16), np.arange(12)) > 14
    atlas["nmse_error"] = atlas.nmse.copy(data=np.where(doubt, 0.1, 1e-4) * atlas.nmse)
    atlas.nmse_error.attrs["long_name"] = "estimated error of normalised mean square error"
    for metric, doubted in (("nmse", doubt), ("convergence_time", ~doubt)):
        flags = np.where(doubted, 1, 2).astype(np.uint8)
        described = store_format.variable(Grid(PLAN), f"{metric}_trusted", "f4")["attributes"]
        atlas[f"{metric}_trusted"] = (atlas.status.dims, flags, described)
    return atlas


def hatched(axes: Axes) -> list[str]:
    return [patch.get_hatch() for patch in axes.patches]


def test_cells_that_are_not_trusted_keep_their_colour_under_a_hatch(judged):
    judged.status[1, 15, :] = 2
    judged.nmse_trusted[1, 15, :] = 0
    plane = select(judged, x="Kenv", y="K0", at={"Td": 5})
    expected = (judged.nmse_trusted.values[1] == 1) & (judged.status.values[1] == 1)
    np.testing.assert_array_equal(plane.untrusted, expected)
    figure = panels([("", plane)])
    hidden = np.ma.getmaskarray(mesh(panel(figure)).get_array())
    assert not hidden[:15].any() and hidden[15].all()
    share = style.share(expected.mean())
    assert legend(figure) == [
        "diverged (6.2 %)",
        f"not trusted: error > max(1 % of nmse, 1e-12) ({share} %)",
    ]
    over = [patch for patch in panel(figure).patches if patch.get_hatch() == style.UNTRUSTED]
    corners = mesh(panel(figure)).get_coordinates()
    for patch in over:  # a light line and a dark one on it, over the colours
        assert patch.get_zorder() > mesh(panel(figure)).get_zorder()
        box = patch.get_path().get_extents()
        rows, columns = np.nonzero(expected)
        np.testing.assert_allclose([box.x0, box.y0], corners[rows.min(), columns.min()])
        np.testing.assert_allclose([box.x1, box.y1], corners[rows.max() + 1, columns.max() + 1])
    assert {to_rgb(patch.get_hatchcolor()) for patch in over} == {to_rgb("w"), to_rgb("k")}


def test_a_plane_that_is_trusted_or_has_no_estimates_gets_no_hatch(judged):
    trusted = judged.copy(deep=True)
    trusted.nmse_trusted[:] = 2
    for data in (judged.drop_vars(["nmse_trusted", "nmse_error"]), trusted):
        figure = plot(data, x="Kenv", y="K0")
        assert hatched(panel(figure)) == [] and legend(figure) == []


def test_a_panel_without_estimates_gets_a_dash_for_its_share(judged):
    bare = judged.drop_vars(["nmse_trusted", "nmse_error"])
    row = [("", select(data, x="Kenv", y="K0", at={"Td": 1})) for data in (judged, bare)]
    assert legend(panels(row)) == ["not trusted: error > max(1 % of nmse, 1e-12) (100, – %)"]


def test_each_metric_has_a_hatch_and_a_bound_of_its_own(judged):
    for metric, drawn in (
        ("nmse", "nmse"),
        ("nmse", "nmse_error"),
        ("convergence_time", "convergence_time"),
    ):
        plane = select(judged, x="Kenv", y="K0", at={"Td": 5}, metric=drawn)
        doubted = judged[f"{metric}_trusted"].values[1] == 1
        np.testing.assert_array_equal(plane.untrusted, doubted)
        bound = {"nmse": "max(1 % of nmse, 1e-12)", "convergence_time": "1 % of $t_{end}$"}[metric]
        share = style.share(doubted.mean())
        assert legend(panels([("", plane)])) == [f"not trusted: error > {bound} ({share} %)"]
    plane = select(judged, x="Kenv", y="K0", at={"Td": 5}, metric="steady_error")
    assert plane.untrusted is None and legend(panels([("", plane)])) == []


def test_an_old_store_hatches_nmse_alone(judged):
    """Formats 1 and 2 have one flag for all; their bound is an attribute."""
    flags = {"trusted": judged.nmse_trusted.drop_attrs()}
    old = judged.drop_vars(["nmse_trusted", "convergence_time_trusted"]).assign(flags)
    figure = plot(old.assign_attrs(trust_bound=0.02), x="Kenv", y="K0", at={"Td": 1})
    assert legend(figure) == ["not trusted: error > 2 % of nmse (100 %)"]
    assert hatched(panel(plot(old, x="Kenv", y="K0", metric="convergence_time"))) == []


def test_a_number_in_a_hatched_cell_has_a_box_of_the_cells_colour(paper):
    paper["nmse_trusted"] = paper.status.copy(data=np.full(paper.status.shape, 2, np.uint8))
    paper.nmse_trusted[1, 0, 0] = 1
    axes = panel(plot(paper, x="Td", y="K0"))
    colours = mesh(axes).to_rgba(mesh(axes).get_array()).reshape(-1, 4)
    boxes = [text.get_bbox_patch() for text in axes.texts]
    assert boxes[0].get_facecolor() == pytest.approx(colours[0])
    assert boxes[1:] == [None] * 19


def test_an_estimated_error_has_a_logarithmic_scale(judged):
    judged.nmse_error[1, 0, 0] = 0.0
    judged.nmse_error[1, 0, 1] = np.inf
    figure = plot(judged, x="Kenv", y="K0", metric="nmse_error")
    assert isinstance(mesh(panel(figure)).norm, LogNorm)
    shown = figure.axes[1].get_ylabel().replace("\n", " ")
    assert shown == "estimated error of normalised mean square error"
    assert legend(figure)[0] == "the two runs part (0.5 %)"
    judged.nmse_error[:] = 0.0
    norm = mesh(panel(plot(judged, x="Kenv", y="K0", metric="nmse_error"))).norm
    assert norm.vmin == 0.0 < norm.vmax


def test_a_flag_is_no_metric_and_an_error_needs_estimates(judged):
    for flag, metric in (("nmse_trusted", "nmse"), ("overshoot_trusted", "overshoot")):
        words = f"'{flag}' is no metric: a picture of '{metric}' marks what is not trusted"
        with pytest.raises(PlotError, match=words):
            plot(judged, x="Kenv", y="K0", metric=flag)
    with pytest.raises(PlotError, match=r"no metric 'nsme_error'. Did you mean 'nmse_error'"):
        plot(judged, x="Kenv", y="K0", metric="nsme_error")
    bare = judged.drop_vars([n for n in judged if n.endswith(("_trusted", "nmse_error"))])
    for metric in ("trusted", "nmse_trusted", "steady_error_error"):
        with pytest.raises(PlotError, match=f"no '{metric}': the store has no error estimates; "):
            plot(bare, x="Kenv", y="K0", metric=metric)


@pytest.mark.parametrize(
    "values", [[-8.0, -3.5e-7, -2e-7, -1e-7], [1e-9, 1.1e-9, 3.0], [0.0, 1e-6, 5.0, 10.0]]
)
def test_each_value_of_an_uneven_list_has_width_and_a_tick(values):
    """On an even scale the close ones had no width, and looked as if they had not been run."""
    axes = panel(plot(dataset(Td=values, K0=[1.0, 2.0]), x="Td", y="K0"))
    (mesh,) = (c for c in axes.collections if isinstance(c, QuadMesh))
    edges = mesh.get_coordinates()[0, :, 0]
    assert np.diff(edges).min() > 0.05 * np.ptp(edges)
    labels = [text.get_text() for text in axes.xaxis.get_ticklabels() if text.get_text()]
    assert len(set(labels)) == len(values)
