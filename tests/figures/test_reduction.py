"""Pictures of a reduced store: choices as a map, places on the scale of their axis, captions."""

import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, to_rgb

from figures import PlotError, plot, style
from sweeps.spec.reading import parse
from sweeps.store.opening import dataset
from tests import legible
from tests.test_runner import complete

AXES = """
name = "reduced"
[time]
t_end = 0.3
[model]
contact = ["welded", "hard_stop"]
law = ["algorithm1", "effort", "energy"]
[axes]
Kenv = [50.0, 500.0, 1e9]
K0 = [1.0, 10.0, 30.0, 100.0]
sigma = { log = [0.001, 0.1], n = 3 }
I = { lin = [1.0, 200.0], n = 2 }
[cases]
Td = [1.0, 5.0]
gap = [0.0, 0.1]
[reduce]
over = ["case", "sigma", "I", "contact"]
best = "law"
by = "nmse"
max = ["nmse"]
"""
DRAWN = """
name = "drawn"
[time]
t_end = 0.2
[model]
contact = ["welded", "hard_stop"]
[cases]
Kenv = [50.0, 500.0]
[sample]
n = 16
ranges = { K0 = { log = [1.0, 1000.0] }, Td = { lin = [1.0, 5.0] } }
[reduce]
"""


def reduced(folder, text):
    return dataset(complete(folder / "store.zarr", parse(text, "f")).path).load()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return reduced(tmp_path_factory.mktemp("axes"), AXES)


def legend(figure):
    (box,) = figure.legends
    handles = zip(box.get_texts(), box.legend_handles, strict=True)
    return {text.get_text(): handle for text, handle in handles}, box.get_title().get_text()


def mesh(figure):
    return next(c for c in figure.axes[0].collections if isinstance(c, QuadMesh))


def test_a_choice_is_a_map_with_a_legend(data):
    figure = plot(data, x="K0", y="Kenv", metric="best_law")
    assert len(figure.axes) == 1  # no colour bar
    entries, _ = legend(figure)
    assert [*entries] == ["Algorithm 1", "effort", "energy", "diverged (33 %)"]
    colours = [
        to_rgb(entries[name].get_facecolor()) for name in ("Algorithm 1", "effort", "energy")
    ]
    assert colours == [to_rgb(colour) for colour in style.CHOICES[:3]]
    figure.draw_without_rendering()
    drawn = mesh(figure)
    chosen = np.nan_to_num(data["best_law"].values).ravel().astype(int)
    assert len(set(chosen)) > 2  # none, and two laws
    for code, colour in zip(chosen, drawn.get_facecolors(), strict=True):
        if code:
            np.testing.assert_allclose(colour[:3], colours[code - 1])
    assert not figure.axes[0].texts  # no numbers
    title = "reduced law whose largest nmse over case, sigma, I, contact is smallest"
    assert figure.get_suptitle().replace("\n", " ") == title
    legible.check(figure)


def test_a_choice_along_a_line_has_its_words_beside_it(data):
    figure = plot(data, x="K0", metric="best_law", at={"Kenv": 50})
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert labels == ["Algorithm 1", "effort", "energy"]
    (dots,) = figure.axes[0].lines
    np.testing.assert_array_equal(dots.get_ydata(), data["best_law"].sel(Kenv=50))


def test_a_choice_over_drawn_fields_is_a_colour_with_a_legend(tmp_path):
    text = DRAWN + 'over = ["case"]\nbest = "contact"\nby = "nmse"'
    figure = plot(reduced(tmp_path, text), x="K0", y="Td", metric="best_contact")
    entries, held = legend(figure)
    assert [*entries] == ["welded", "hard stop"]
    assert len(figure.axes) == 1
    at_best = "at the best of welded and hard stop"
    assert "over 2 cases of $K_{env}$ = 50 to 500 N·m/rad" in held and at_best in held


@pytest.mark.parametrize(
    ("metric", "log"), [("nmse_max_sigma", True), ("nmse_max_I", False), ("nmse_max_gap", False)]
)
def test_places_have_the_scale_of_their_axis(data, metric, log):
    figure = plot(data.isel(Kenv=[0, 1]), x="K0", y="Kenv", metric=metric)
    assert isinstance(mesh(figure).norm, LogNorm) == log


def test_captions_say_what_is_gone(data, tmp_path):
    _, held = legend(plot(data, x="K0", y="Kenv", metric="nmse_at_best"))
    held = held.replace("\n", " ")
    assert "over 2 cases of $T_d$ = 1 to 5 N·m and gap = 0 to 0.1 rad, over 3 values of " in held
    assert r"over 3 values of $\sigma$ = 0.001 to 0.1, over 2 values of $I$ = 1 to 200 kg" in held
    ends = "over welded and hard stop, at the best of Algorithm 1, effort and energy"
    assert held.endswith(ends)
    drawn = reduced(tmp_path, DRAWN + 'over = ["scenario"]\nmax = ["nmse"]')
    figure = plot(drawn, x="case", metric="nmse_max_K0", at={"contact": "welded"})
    _, held = legend(figure)
    said = "over 16 drawn scenarios of $K_0$ = 1 to 1000 N·m/rad and $T_d$ = 1 to 5 N·m"
    assert said in held.replace("\n", " ")
    assert figure.axes[0].get_yscale() == "log"


@pytest.mark.parametrize("request_", [{"y": "Td"}, {"at": {"gap": 0}}, {"x": "case"}])
def test_an_axis_that_is_gone_is_named(data, request_):
    with pytest.raises(PlotError) as refused:
        plot(data, **{"x": "K0", "y": "Kenv", "metric": "nmse_max"} | request_)
    name = next(n for n in ("Td", "gap", "case") if n in str(request_))
    said = f"'{name}' was reduced over: each cell is of all its values. There are: Kenv, K0."
    assert str(refused.value) == said


def test_a_dimension_of_which_the_best_is_known_is_named(data):
    with pytest.raises(PlotError, match="'law' was reduced to its best value, which"):
        plot(data, x="law", metric="nmse_max")


@pytest.mark.parametrize("name", ["status", "nmse_status"])
def test_a_status_is_no_metric(data, name):
    with pytest.raises(PlotError, match=f"^'{name}' is no metric: a picture of a metric hatches"):
        plot(data, x="K0", y="Kenv", metric=name)
