"""The gallery: each figure draws its sweep at a reduced size; what its sentences say holds there.

The numbers of docs/gallery.md come from the full sweeps by the same functions.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.text import Text

import sweeps
from figures import style
from figures.atlas import FIGURES, best, convergence, expected, impact, lost, nmse, period, write
from figures.atlas.numbers import converged
from sweeps.spec.reading import load
from sweeps.store.opening import dataset
from tests import legible

ROOT = Path(__file__).parents[2]
K0 = "K0={ log = [1.0, 1000.0], n = 7 }"
KENV = "Kenv={ log = [10.0, 1000.0], n = 4 }"
DENV = "Denv=[1.0, 10.0, 100.0, 1000.0]"
SIZES = {
    "atlas": (K0, KENV, DENV, "Td=[1.0, 5.0, 10.0, 20.0]", "sigma=[0.01]"),
    "atlas-period": ("sigma={ log = [0.001, 1.0], n = 10 }", "period=[0.01, 0.05, 0.1, 0.2]"),
    "atlas-expected": (
        "gap={ lin = [0.3, 0.5], n = 5 }",
        "xd={ lin = [0.0, 0.8], n = 17 }",
    ),
    "atlas-impact": (
        "Kenv={ log = [10.0, 10000.0], n = 7 }",
        "v_init={ log = [0.01, 10.0], n = 7 }",
    ),
    "atlas-lost": ("Kenv=[10.0, 100.0, 500.0, 1000.0]", "Denv={ log = [1.0, 1000.0], n = 7 }"),
    "atlas-best": (K0, KENV, DENV, "sigma={ log = [0.001, 1.0], n = 7 }"),
    "atlas-usual": (K0, KENV, DENV),
    "atlas-settled": (K0, KENV, DENV, "sigma={ log = [0.001, 1.0], n = 7 }"),
    "atlas-errors": (K0, KENV),
}

# The atlases go beyond Fmax and x0 on purpose, and `sweeps.run` says so.
pytestmark = pytest.mark.filterwarnings("ignore:atlas:UserWarning")


@pytest.fixture
def drawn(tmp_path):
    """Run the sweeps of figures at their reduced sizes, draw and read them; returns their data."""

    def draw(name, *others):
        figure = FIGURES[name]
        for sweep in figure.SWEEPS:
            path = sweeps.LIBRARY / f"{sweep}.toml"
            sweeps.run(load(path, SIZES[sweep]), tmp_path / f"{sweep}.zarr")
        data = [dataset(tmp_path / f"{sweep}.zarr").load() for sweep in figure.SWEEPS]
        for one in (name, *others):
            check(FIGURES[one].plot(*data), {"expected": 2, "best": 3}.get(one, 1))
            text = FIGURES[one].finding(*data)
            assert len(re.findall(r"[.](?= [A-Z]|$)", text)) == 2 and "nan" not in text, text
        return data

    return draw


def check(figure, scales):
    """Readable in a column or on a page of a paper, with units, and a scale for each metric."""
    legible.check(figure)
    assert figure.get_figwidth() in (style.COLUMN_WIDTH, style.PAGE_WIDTH)
    inked = figure.get_tightbbox()
    assert inked.x0 >= -0.01 and inked.x1 <= figure.bbox_inches.x1 + 0.01
    numbers = {id(text) for axes in figure.axes for text in axes.texts}  # in cells: these are few
    for text in figure.findobj(Text):
        assert text.get_fontsize() >= style.SMALL_SIZE or id(text) in numbers, text
    assert re.search(r"[(](N·m|rad|s)", " ".join(axes.get_ylabel() for axes in figure.axes))
    maps = [item for axes in figure.axes for item in axes.collections if isinstance(item, QuadMesh)]
    wide = [one for one in maps if one.axes.get_label() != "<colorbar>"]
    assert len({(one.norm.vmin, one.norm.vmax) for one in wide}) == scales


def test_every_entry_of_the_stored_page_has_its_picture():
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    pictures = re.findall(r"]\((gallery/.*?)\)", page)
    assert pictures == [f"gallery/{name}.png" for name in FIGURES]
    assert all((ROOT / "docs" / picture).exists() for picture in pictures)


def test_damping_decides_and_at_low_damping_stiff_controllers_converge(drawn):
    (atlas,) = drawn("nmse", "convergence")
    small = (atlas["nmse"] <= nmse.SMALL).sel(Td=[1.0, 5.0, 10.0]).mean(["Td", "K0", "Kenv"])
    assert float(small.sel(Denv=1.0).item()) == 0.0
    assert float(small.sel(Denv=100.0).item()) < float(small.sel(Denv=1000.0).item())
    # beyond Fmax: ((20 - 15) / 15)^2
    assert float(atlas["nmse"].sel(Td=20.0).min()) > 0.95 / 9.0
    good = converged(atlas)
    soft = good["K0"] * convergence.X0 < good["Td"]
    for Denv, softer in ((1.0, False), (1000.0, True)):
        one = good.sel(Denv=Denv)
        assert bool(one.where(soft).mean() > one.where(~soft).mean()) == softer


def test_the_least_ratio_of_sigma_and_period_hardly_depends_on_the_period(drawn):
    (data,) = drawn("period")
    rate = period.least_rate(data)
    step = 10 ** (1 / 3)  # between two sigma
    assert float((rate.max("period") / rate.min("period")).max()) < 2.4 * step
    assert (np.diff(rate.median("period")) > 0).all()


def test_the_error_of_xd_is_its_distance_from_the_gap(drawn):
    (data,) = drawn("expected")
    shown = expected.by_error(data)
    for gap, error in ((0.3, -0.3), (0.4, 0.0), (0.5, 0.3)):
        there = shown.sel(gap=gap, method="nearest").sel(xd_error=error, method="nearest")
        same = data.sel(gap=gap, xd=gap + error, method="nearest")
        np.testing.assert_array_equal(there["nmse"], same["nmse"])
    steady = shown["steady_error"].median("gap").sel(xd_error=[-0.1, 0.1])
    assert (steady.sel(xd_error=0.1) > 0.1).all()
    assert float(steady.sel(xd_error=-0.1, K0=1000.0)) == pytest.approx(-1.0, abs=1e-3)


def test_a_hard_impact_is_that_of_a_free_body(drawn):
    (data,) = drawn("impact")
    for D in data["Denv"].values:
        hard = impact.rule(data["v_init"], data["Kenv"], D)
        ratio = (data["peak_torque"].sel(Denv=D) / hard).where(hard > impact.HARD)
        assert float(ratio.quantile(0.1)) > 0.6 and float(ratio.quantile(0.9)) < 1.2
    gentle = data.sel(Denv=0.0, v_init=0.01, Kenv=10000.0)
    assert float(gentle["peak_torque"]) > impact.FMAX and float(gentle["contact_lost"]) > 0.0


def test_stiffer_environments_need_more_damping_to_keep_contact(drawn, tmp_path):
    (data,) = drawn("lost")
    damping = [lost.needed(data, K) for K in lost.STIFF]
    assert damping == sorted(damping) and damping[0] < damping[-1]
    ((name, entry),) = write(tmp_path, ["lost"])
    assert (tmp_path / f"{name}.png").exists() and (tmp_path / f"{name}.svg").exists()
    for text in ("](gallery/lost.png)", "fic-sweep run atlas-lost --out", "gap = 0.5 rad"):
        assert text in entry
    kept = (data["contact_lost"] == 0).mean(["Kenv", "Denv"])
    assert (np.diff(kept) > 0).all()


def test_the_best_sigma_grows_with_k0_and_falls_with_kenv(drawn):
    both = drawn("best")
    data = best.with_cost(*both).sel(contact="hard_stop")
    one = data["best_sigma"]
    assert float(one.sel(K0=1000.0, Kenv=10.0)) > float(one.sel(K0=100.0, Kenv=1000.0))
    assert float(data["cost"].where(data["cost_status"] == 1).min()) >= 1.0


def test_a_stiff_controller_settles_more_often_with_a_larger_sigma(drawn):
    (data,) = drawn("settled")
    share = data["settled_share"].sel(contact="hard_stop", Td=5.0)
    top = share.idxmax("sigma")
    assert float(top.sel(K0=1000.0)) > float(top.sel(K0=100.0))
    assert float(share.sel(K0=1000.0).max()) > 2 * float(share.sel(K0=1000.0, sigma=0.01))


def test_located_switches_have_smaller_errors(drawn):
    (data,) = drawn("errors")
    trusted = (data["nmse_trusted"] == 2).mean(["Denv", "K0", "Kenv"])
    assert float(trusted.sel(integrator="rk4_events")) > float(trusted.sel(integrator="rk4"))
