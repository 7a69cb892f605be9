"""The paper's figures: what is drawn, on which axes, and the physics behind the derived ones."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import FillBetweenPolyCollection

import figures.paper
from fic_jax import Model, Params, energy, evaluate, rollout
from figures import signal, style
from figures.paper import (
    attractor,
    environments,
    histories,
    look,
    profile,
    superposition,
    welded_contact,
)
from figures.paper import energy as energies
from sweeps.paper import scenarios
from tests import legible

MARKS = {"nmse": 1e-3, "nmse_tail": 1e-6}


def grid(fields, period=0.01, **attrs):
    """Metrics that differ in every cell, so that a swapped axis shows."""
    shape = tuple(len(values) for values in fields.values())
    ramp = 1.0 + np.arange(np.prod(shape)).reshape(shape)
    cells = {name: (tuple(fields), mark * ramp) for name, mark in MARKS.items()}
    return xr.Dataset(cells, dict(fields), {"period": period} | attrs)


def portrait(peaks):
    """Half ellipses out to each peak and back, one path each."""
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    e = np.outer(peaks, np.sin(angle / 2.0))
    rate = np.outer(peaks, np.cos(angle / 2.0))
    runs = {"e": e, "rate": rate, "diverging": rate > 0.0}
    return xr.Dataset({name: (("path", "t"), run) for name, run in runs.items()})


def motions(field, values, torques, gap):
    """Torques and positions that creep towards a value of their own."""
    t = 0.01 * np.arange(1, 1001)
    shares = 1.0 - np.exp(-np.multiply.outer(1.0 + np.arange(len(values)), t))
    torque = np.multiply.outer(torques, shares)
    x = gap + 0.01 * torque
    dims = ("Td", field, "time")
    coords = {"Td": torques, field: list(values), "time": t}
    return xr.Dataset(
        {"tau_env": (dims, torque), "x": (dims, x)}, coords, {"period": 0.01, "gap": gap}
    )


FIG_4 = {"contact": ["welded", "hard_stop"], "xd": [0.0, 0.001], "K0": [1.0, 10.0], "Td": [1.0, 5]}
STUDIES = [grid({"xd": list(environments.ESTIMATES), f: [1.0, 2.0, 4.0]}) for f in ("Kenv", "Denv")]


@pytest.fixture(scope="module")
def laws():
    return {law: superposition.compute(law) for law in superposition.TITLES}


@pytest.fixture(scope="module")
def balance():
    return energies.compute(n=120)


@pytest.fixture(scope="module")
def drawn(laws, balance):
    """Every script's figure of small data."""
    return {
        "profile": profile.plot(profile.compute(n=601)),
        "attractor": attractor.plot(portrait([0.1, -0.2, 0.3])),
        "energy": energies.plot(balance),
        "superposition": superposition.plot(tuple(laws.values())),
        "welded_contact": welded_contact.plot(grid(FIG_4)),
        "environments": environments.plot(tuple(STUDIES)),
        "histories": histories.plot(motions("K0", look.STIFFNESSES, [1.0, 5.0, 20.0], 0.0)),
        "approach": histories.plot(motions("Kenv", [50.0, 500.0], [5.0], 0.5)),
    }


LABELS = {
    "profile": (r"error $|\tilde{x}|$ (rad)", "torque $F_K$ (N·m)"),
    "attractor": (r"$\tilde{x}$ (rad)", r"$\dot{\tilde{x}}$ (rad/s)"),
    "energy": (r"peak error $|\tilde{x}_{Max}|$ (rad)", "energy (J)"),
    "superposition": (r"$\tilde{x}$ (rad)", "controller torque $h_e$ (N·m)"),
    "welded_contact": ("$T_d$ (N·m)", "normalised MSE,\nwhole run"),
    "environments": ("$K_{env}$ (N·m/rad)", "normalised MSE,\nlast 5 s"),
    "histories": ("$t$ (s)", "torque $T$ (N·m)"),
    "approach": ("$t$ (s)", "torque $T$ (N·m)"),
}
N_PANELS = {
    "profile": 2,
    "attractor": 1,
    "energy": 2,
    "superposition": 2,
    "welded_contact": 4,
    "environments": 4,
    "histories": 9,
    "approach": 3,
}


@pytest.mark.parametrize("name", LABELS)
def test_panels_and_labels(drawn, name):
    panels = drawn[name].axes
    assert len(panels) == N_PANELS[name]
    shown = {ax.get_xlabel() for ax in panels}, {ax.get_ylabel() for ax in panels}
    assert LABELS[name][0] in shown[0] and LABELS[name][1] in shown[1]


@pytest.mark.parametrize("name", LABELS)
def test_fits_its_column_and_no_legend_covers_data(drawn, name):
    figure = drawn[name]
    FigureCanvasAgg(figure).draw()
    assert figure.get_figwidth() in (style.COLUMN_WIDTH, style.PAGE_WIDTH)
    sheet, inked = figure.bbox_inches, figure.get_tightbbox()
    assert min(inked.x0, inked.y0) >= 0 and inked.x1 <= sheet.x1 and inked.y1 <= sheet.y1
    for legend in figure.legends:
        others = [ax.bbox for ax in figure.axes]
        others += [text.get_window_extent() for text in figure.texts]
        assert not any(legend.get_window_extent().overlaps(other) for other in others)
    assert plt.get_fignums() == []


def test_one_call_writes_every_figure(tmp_path, monkeypatch):
    monkeypatch.setattr(figures.paper, "SCRIPTS", (profile, superposition))
    assert list(figures.paper.write(tmp_path)) == ["profile", "superposition"]
    assert (tmp_path / "profile.png").stat().st_size > 0


def test_figures_simulate_the_scenarios_that_they_label(monkeypatch):
    """A cell is the scenario that its coordinates say, in metrics and in histories."""
    monkeypatch.setattr(scenarios, "T_END", 0.2)
    welded = Model(contact="welded").with_events()
    cells = welded_contact.simulate(0.01).sel(contact="welded", xd=0.001, K0=100.0, Td=1.0)
    runs = histories.simulate("history_welded", 0.01)
    alone = evaluate(Params(K0=100.0, Td=1.0, xd=0.001), model=welded, dt=0.01, n_steps=20)
    motion = rollout(Params(K0=100.0, Td=1.0), model=welded, dt=0.01, n_steps=20)
    # float64; the programs are of different shapes, which may round differently
    assert float(cells["nmse"]) == pytest.approx(float(alone.nmse), rel=1e-12)
    own = runs.sel(K0=100.0, Td=1.0)
    np.testing.assert_allclose(own["tau_env"], motion.tau_env, rtol=1e-12)
    np.testing.assert_allclose(own["time"], motion.t, rtol=1e-12)
    assert list(runs["Td"]) == [1.0, 5.0, 20.0] and runs.attrs["gap"] == 0.0
    near, far = environments.simulate(0.01)
    free = Params(Denv=63.2, gap=0.5, xd=0.501)
    damped = evaluate(free, model=Model().with_events(), dt=0.01, n_steps=20)
    assert float(far["nmse"].sel(Denv=63.2, xd=0.501)) == pytest.approx(float(damped.nmse))
    assert near["nmse"].dims == ("xd", "Kenv") and list(near["xd"]) == [0.5, 0.501, 0.001]


def test_profile_saturates_before_xb(drawn):
    """b ln(1000 |dF|/Fmax) beyond x0: 0.1043 rad at the latest, for K0 = 1000."""
    whole, near = drawn["profile"].axes
    assert near.get_yscale() == "log" and near.get_xlim() == (0.099, 0.111)
    curves = [line for line in near.lines if len(line.get_xdata()) == 601]
    last = [line.get_xdata()[line.get_ydata() > profile.STATED].max() for line in curves]
    # at most a node of 0.25 mrad short of it
    expected = 0.1 + 5e-4 * np.log(1e3 * np.abs(15.0 - 0.1 * np.array(look.STIFFNESSES)) / 15.0)
    np.testing.assert_allclose(last, expected, atol=2.5e-4)
    assert whole.lines[3].get_ydata()[400] == pytest.approx(10.0)  # K0 x0 for K0 = 100


def test_portrait_omits_paths_beyond_the_largest_peak():
    figure = attractor.plot(portrait([0.1, 0.3, 0.31, -0.5]))
    paths = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 41]
    peaks = sorted({float(np.nanmax(line.get_xdata())) for line in paths})
    assert len(paths) == 4 and peaks == pytest.approx([0.1, 0.3])  # two branches each
    assert figure.axes[0].get_xlim()[1] >= 0.3


def test_portrait_tells_the_branches_apart():
    data = portrait([0.2])
    branches = {line.get_color(): line for line in attractor.plot(data).axes[0].lines}
    away, home = (branches[c].get_ydata() for c in (look.DIVERGENCE, look.CONVERGENCE))
    assert np.nanmin(away) > 0.0
    assert np.nanmin(home) < 0.0 and np.nanmax(home) < 0.2 * np.sin(0.1)  # and the joining sample


def test_attractor_turns_its_energy_into_the_peak_and_comes_home():
    data = attractor.simulate(energies=(0.125, 2.0), dt=0.002, t_end=4.0)
    peaks = abs(data["e"]).max("t").values
    # the peak is seen at samples: half a step from it e is short by F dt^2/(8 I) = 8e-7 rad
    np.testing.assert_allclose(energy(peaks, Params()), data["energy"], rtol=2e-5)
    assert abs(data["e"]).isel(t=-1).max() < 1e-9 and abs(data["rate"]).isel(t=-1).max() < 1e-9
    # 1e-9: where a switch is located a step later, the branch that follows is another by rounding
    np.testing.assert_allclose(data["e"][0], -data["e"][1], atol=1e-9)


def test_older_law_releases_what_it_absorbed(balance):
    # trapezoids of |slope (e - e_M/2)| miss at most the cell with the kink: (1/400)^2 of it
    np.testing.assert_allclose(balance.older, balance.absorbed, rtol=1e-5)


def test_algorithm_1_releases_more_up_to_twice_the_absorbed_over_the_force(balance):
    """The slopes cross where E_K(e) = F_K(e) e/2: 0.1337 rad, beyond xb = 0.11."""
    p, b = Params(), (0.11 - 0.10) / 20.0
    crossing = 2.0 * p.x0 - (p.K0 * p.x0**2 - 2.0 * b * (p.Fmax - p.K0 * p.x0)) / p.Fmax
    assert crossing == pytest.approx(0.13367, abs=1e-5)
    # interpolated linearly between peaks 2.5 mrad apart
    assert energies.sign_change(balance) == pytest.approx(crossing, abs=2e-4)
    gain = balance.released - balance.absorbed
    more = (balance.e_M > p.x0 + 1e-9) & (balance.e_M < crossing)
    assert np.all(gain[more] > 0) and np.all(gain[balance.e_M > crossing] < 0)
    assert np.max(np.abs(gain[balance.e_M <= p.x0])) < 1e-5
    # the part of [0, e_M] above x0 has the other slope: (s_F - s_E) x0 (e_M - x0)/2 up to 2 x0
    e_M = balance.e_M[39]
    s_F, s_E = 2.0 * p.Fmax / e_M, 4.0 * balance.absorbed[39] / e_M**2
    assert e_M < 2.0 * p.x0
    assert gain[39] == pytest.approx((s_F - s_E) * p.x0 * (e_M - p.x0) / 2.0, rel=1e-4)


def test_energy_areas_lie_where_the_difference_has_their_sign(drawn):
    _, near = drawn["energy"].axes
    areas = [a for a in near.collections if isinstance(a, FillBetweenPolyCollection)]
    more, less = (np.concatenate([path.vertices for path in a.get_paths()]) for a in areas)
    assert more[:, 1].min() >= 0.0 and more[:, 0].min() < 0.104 and more[:, 0].max() < 0.134
    assert less[:, 1].max() <= 0.0 and less[:, 0].max() == pytest.approx(0.3)
    assert areas[0].get_hatch() != areas[1].get_hatch()  # distinguished without green and red


def test_limited_torque_releases_no_more(balance):
    slack = 1e-12  # J, rounding
    assert np.all(balance.limited <= balance.released + slack)
    assert np.all(balance.older_limited <= balance.older + slack)
    assert balance.older_limited[-1] < 0.9 * balance.older[-1]


def test_branches_are_superimposed_for_algorithm_1_only(laws, drawn):
    Fmax = Params().Fmax
    assert np.max(np.abs(superposition.jumps(laws["algorithm1"]))) < 1e-6 * Fmax
    older = superposition.jumps(laws["energy"])
    # 2 E_K(e_M)/e_M - F_K(e_M): none in the linear zone, then less, then more than Fmax
    expected = [0.0, 2.0 * 0.6475 / 0.11 - 15.0, 2.0 * 1.9975 / 0.2 - 15.0]
    np.testing.assert_allclose(older, expected, atol=1e-6 * Fmax)
    left, right = drawn["superposition"].axes
    assert left.get_ylim() == right.get_ylim()
    assert (left.get_title(), right.get_title()) == ("Algorithm 1", "older law")
    assert [t.get_text() for t in left.texts].count("no jump") == 3
    assert "jump −3.2 N·m" in [t.get_text() for t in right.texts]


def test_algorithm_1_jumps_at_x0_instead(laws):
    """Its slope changes there: (s_F - s_E)(x0 - e_M/2) = 2.64 N*m for e_M = 0.11."""
    at, jump = superposition.broken(laws["algorithm1"].convergence[1])
    assert at == pytest.approx(0.1, abs=1e-4)  # a node apart
    s_F, s_E = 2.0 * 15.0 / 0.11, 4.0 * 0.6475 / 0.11**2
    assert jump == pytest.approx((s_F - s_E) * (0.1 - 0.055), rel=1e-3)


def test_the_controller_limits_what_is_drawn_solid(laws):
    for law in laws.values():
        for branch in (law.divergence, *law.convergence):
            assert np.max(np.abs(branch.torque)) <= 15.0
    assert np.max(laws["energy"].convergence[2].unlimited) == pytest.approx(19.975, abs=1e-6)


def test_welded_beside_contact_on_the_same_scale(drawn):
    above, below = np.reshape(drawn["welded_contact"].axes, (2, 2))
    for left, right in (above, below):
        assert left.get_yscale() == "log" and left.get_ylim() == right.get_ylim()
    assert [ax.get_title() for ax in above] == ["welded", "contact (hard stop)"]
    assert [t.get_text() for t in below[0].get_xticklabels()] == ["1", "5"]
    cells = grid(FIG_4)["nmse"].sel(contact="hard_stop").transpose("K0", "xd", "Td").values
    marks = [line.get_ydata() for line in above[1].lines if line.get_ls() == "None"]
    np.testing.assert_array_equal(marks, cells.reshape(4, 2))
    assert drawn["welded_contact"].get_suptitle() == "plant step and control period 10 ms"


def test_bounds_stand_where_the_text_states_them(drawn):
    stated = [
        [line.get_ydata()[0] for line in ax.lines if line.get_color() == look.REFERENCE]
        for ax in drawn["welded_contact"].axes
    ]
    assert stated == [[0.1], [], [1e-4], [0.1]]


def test_environments_have_a_row_for_each_half_and_one_marker_for_each_estimate(drawn):
    """An open marker was the last 5 s here and the 1 % error in the figure beside it."""
    above, below = np.reshape(drawn["environments"].axes, (2, 2))
    for left, right in (above, below):
        assert left.get_yscale() == "log" and left.get_ylim() == right.get_ylim()
    assert below[1].get_xlabel() == "$D_{env}$ (N·m·s/rad)"
    for axes, metric in ((above[0], "nmse"), (below[0], "nmse_tail")):
        marks = [line for line in axes.lines if line.get_ls() == "None"]
        drawn_marks = [line.get_ydata() for line in marks]
        np.testing.assert_array_equal(drawn_marks, STUDIES[0][metric])
        assert len({line.get_color() for line in marks}) == 3
        assert len({line.get_marker() for line in marks}) == 3
    texts = [t.get_text() for t in drawn["environments"].legends[0].get_texts()]
    assert texts[1].endswith("$x_d$ = 0.501 rad") and texts[2].endswith("$x_d$ = 0.001 rad")


@pytest.mark.parametrize("name", ["welded_contact", "environments"])
def test_no_marker_is_open_where_that_could_mean_not_trusted(drawn, name):
    for axes in drawn[name].axes:
        for line in axes.lines:
            assert line.get_marker() in ("_", "None") or line.get_mfc() == line.get_color()
    assert drawn[name].legends[0].get_texts()[-1].get_text() == "no mark: not trusted"


@pytest.mark.parametrize("name", LABELS)
def test_every_picture_can_be_read_in_a_column_and_in_grey(drawn, name):
    """The lightest lines had a contrast of 1.7 on white; the inset's letters were 5.5 pt."""
    legible.check(drawn[name])


def test_a_profile_beyond_its_axis_is_marked(drawn):
    """K0 = 1000 reaches 100 N*m at x0, five times the height of the axis."""
    whole = drawn["profile"].axes[0]
    (mark,) = [line for line in whole.lines if line.get_marker() == "^"]
    assert mark.get_xydata().tolist() == [[pytest.approx(0.1), whole.get_ylim()[1]]]
    assert "to 100" in [text.get_text() for text in whole.texts]


def test_histories_draw_torque_error_and_position(drawn):
    data = motions("K0", look.STIFFNESSES, [1.0, 5.0, 20.0], 0.0)
    axes = np.reshape(drawn["histories"].axes, (3, 3))
    assert [ax.get_title() for ax in axes[0]] == [f"$T_d$ = {Td} N·m" for Td in (1, 5, 20)]
    for row, expected in zip(axes, (data.tau_env, data.tau_env - data.Td, data.x), strict=True):
        for ax, Td in zip(row, data.Td, strict=True):
            curves = [line.get_ydata() for line in ax.lines if len(line.get_xdata()) == 1000]
            np.testing.assert_allclose(curves, expected.sel(Td=Td), rtol=1e-12)
            assert ax.get_xlim() == (0.0, 10.0)
    legend = [t.get_text() for t in drawn["histories"].legends[0].get_texts()]
    assert legend[:2] == ["$K_0$ = 0.1 N·m/rad", "$K_0$ = 1 N·m/rad"]


def levels(ax):
    return sorted(line.get_ydata()[0] for line in ax.lines if len(line.get_xdata()) == 2)


def test_histories_mark_limit_and_environment(drawn):
    axes = np.reshape(drawn["histories"].axes, (3, 3))
    assert levels(axes[0, 2]) == [15.0, 20.0] and levels(axes[1, 2]) == [-5.0, 0.0]
    assert levels(axes[0, 1]) == [5.0] and levels(axes[1, 1]) == [0.0]


def test_a_spike_leaves_the_error_row_and_stays_in_the_torque_row():
    data = motions("Denv", [0.0, 189.7], [5.0], 0.5)
    data["tau_env"][0, 1, 100:105] = 50.0
    torque, error, position = histories.plot(data).axes
    assert torque.get_ylim()[1] > 50.0 and error.get_ylim()[1] < 5.0
    assert error.get_ylim()[0] < -4.0  # where the error of the first 2 % lies
    assert levels(position) == [0.5]
    # and a mark says so where it leaves
    (mark,) = [line for line in error.lines if line.get_marker() == "^"]
    assert mark.get_xydata().tolist() == [[pytest.approx(1.01), error.get_ylim()[1]]]
    assert "to 45" in [text.get_text() for text in error.texts]


def test_a_fast_oscillation_is_a_band():
    """Welded, K0 = 0.1, Td = 1 was a block of ink that hid all other lines."""
    data = motions("K0", [0.1, 10.0], [1.0], 0.0)
    data["tau_env"][0, 0] = 1.0 + 2.0 * np.sin(2 * np.pi * 10 * data["time"])
    figure = histories.plot(data)
    torque, error, position = figure.axes
    for axes, centre in ((torque, 1.0), (error, 0.0)):
        (band,) = [c for c in axes.collections if isinstance(c, FillBetweenPolyCollection)]
        box = band.get_paths()[0].get_extents()
        assert [box.y0, box.y1] == pytest.approx([centre - 2.0, centre + 2.0], abs=0.1)
    assert not position.collections
    assert signal.LABEL in [text.get_text() for text in figure.legends[0].get_texts()]
