"""`plot`, `history` and `export`: where they write, what they refuse, what they say."""

import os
import re
import shlex

import numpy as np
import pytest
import xarray as xr

from figures import style
from sweeps.cli import output
from tests.command import call, typed

MAP = ["plot", "cube.zarr", "--x", "K0", "--y", "Td"]
CUBE = """
name = "cube"
[time]
t_end = 0.2
[constants]
Kenv = 200.0
[axes]
K0 = [10.0, 100.0]
Td = [1.0, 2.0, 4.0, 10.0]
sigma = { lin = [1.0, 1.5], n = 3 }
"""
DESIGN = """
name = "design"
[time]
t_end = 0.2
[sample]
n = 16
ranges = { K0 = { log = [1.0, 1000.0] }, Kenv = { lin = [10.0, 100.0] } }
"""


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """A folder with a store of three dimensions, and one of a random design."""
    folder = tmp_path_factory.mktemp("stores")
    for name, text in (("cube", CUBE), ("design", DESIGN)):
        (folder / f"{name}.toml").write_text(text)
        call("run", f"{name}.toml", code=0, folder=folder)
    return folder


@pytest.fixture
def there(stores, tmp_path, monkeypatch):
    """A working directory with links to the stores; what commands write stays in it."""
    for name in ("cube", "design"):
        (tmp_path / f"{name}.zarr").symlink_to(stores / f"{name}.zarr")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(folder):
    return sorted(p.name for p in folder.iterdir() if not p.name.endswith(".zarr"))


def test_the_default_name_tells_store_metric_axes_and_cut(there):
    """Two cuts wrote the same file."""
    for cut in (["Td=4", "sigma=1.25"], ["Td=10", "sigma=1.5"]):
        done = typed("plot", "cube.zarr", "--x", "K0", "--metric", "nmse_tail", "--at", *cut)
        assert (done.code, done.stderr) == (0, "")
        assert done.stdout == f"wrote cube-nmse_tail-K0-{'-'.join(cut)}.png\n"
    assert typed(*MAP, "--at", "sigma=1.25").code == 0
    assert written(there) == [
        "cube-nmse-K0-Td-sigma=1.25.png",
        "cube-nmse_tail-K0-Td=10-sigma=1.5.png",
        "cube-nmse_tail-K0-Td=4-sigma=1.25.png",
    ]


COMMANDS = {
    "p.svg": [*MAP, "--at", "sigma=1.25"],
    "h.pdf": ["history", "cube.zarr", "--at", "K0=10", "Td=4", "sigma=1.25"],
    "t.csv": ["export", "cube.zarr", "--to", "csv"],
    "t.parquet": ["export", "cube.zarr", "--to", "parquet"],
    "t.nc": ["export", "cube.zarr", "--to", "netcdf"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_an_existing_file_is_replaced_only_by_force(there, name):
    """`plot --out thesis.tex` replaced the thesis."""
    (there / name).write_text("somebody's")
    refused = typed(*COMMANDS[name], "--out", name)
    assert refused.code == 2 and (there / name).read_text() == "somebody's"
    message = f"fic-sweep: {name}: exists already; --force replaces it, --out names another\n"
    assert refused.stderr == message
    done = typed(*COMMANDS[name], "--out", name, "--force")
    assert done.code == 0 and done.stdout.startswith(f"wrote {name}")
    assert b"somebody" not in (there / name).read_bytes()
    beside = [f"{name}-metadata.json"] if name.endswith(".csv") else []
    assert written(there) == [name, *beside]


def test_a_default_name_is_refused_too(there):
    again = [typed(*MAP, "--at", "sigma=1.25") for _ in range(2)]
    assert [done.code for done in again] == [0, 2]
    again = [typed("export", "cube.zarr", "--to", "csv") for _ in range(2)]
    assert [done.code for done in again] == [0, 2]


@pytest.mark.parametrize("name", ["p.svg", "h.pdf"])
def test_a_picture_is_never_half_written(there, name, monkeypatch):
    class Breaks(style.FigureCanvasAgg):
        def print_figure(self, path, **_):
            path.write_text("half")
            raise OSError(28, "No space left on device")

    (there / name).write_text("whole")
    monkeypatch.setattr(style, "FigureCanvasAgg", Breaks)
    done = typed(*COMMANDS[name], "--out", name, "--force")
    assert (done.code, done.stderr.count("\n")) == (1, 1)
    assert f"{name}: can't be written: No space left on device" in done.stderr
    assert written(there) == [name] and (there / name).read_text() == "whole"


def test_force_writes_through_a_link(there):
    (there / "real.png").write_text("old")
    (there / "link.png").symlink_to("real.png")
    assert typed(*MAP, "--out", "link.png").code == 2
    assert typed(*MAP, "--out", "link.png", "--force").code == 0
    assert (there / "link.png").is_symlink()
    assert (there / "real.png").read_bytes().startswith(b"\x89PNG")


def test_a_value_that_was_not_run_is_warned_of(there):
    done = typed(*MAP, "--at", "sigma=1.3")
    assert done.code == 0
    (line,) = done.stderr.splitlines()
    assert line.endswith("cube.zarr has no sigma = 1.3; drawn is the nearest, 1.25")
    assert typed(*MAP, "--at", "sigma=1.25", "--out", "exact.png").stderr == ""


def test_a_cut_that_nobody_chose_is_named_and_its_words_work(there):
    done = typed(*MAP)
    middle = re.fullmatch(r"wrote .*\ndrawn at (--at .*), because .*\n", done.stdout)[1]
    again = typed(*MAP, *shlex.split(middle), "--force")
    assert (again.code, again.stdout) == (0, done.stdout.splitlines(keepends=True)[0])


@pytest.mark.parametrize(
    "cut", [["--at", "Td=4", "sigma=1.25"], ["--at", "Td=4,sigma=1.25"],
            ["--at", "Td=4", "--at", "sigma=1.25"], ["--at", " Td = 4 , sigma = 1.25 "]],
)  # fmt: skip
def test_several_values_may_be_given_in_any_way(there, cut):
    done = typed("plot", "cube.zarr", "--x", "K0", *cut)
    assert done.stdout == "wrote cube-nmse-K0-Td=4-sigma=1.25.png\n"


WRONG = [
    ([*MAP, "--at", "Td=4"], "'Td' is drawn as an axis; `at` cannot fix it too."),
    ([*MAP, "--at", "Kenv=5"], "'Kenv' does not vary here: it is 200 N*m/rad. There are: K0, Td"),
    ([*MAP, "--at", "I=5"], "'I' does not vary here: it is 10 kg*m^2."),
    ([*MAP, "--at", "sgima=1"], "There is no dimension 'sgima'. Did you mean 'sigma'?"),
    ([*MAP, "--at", "sigma=9"], "sigma = 9 lies outside the sweep, which covers 1 to 1.5."),
    ([*MAP, "--at", "sigma=1,1.5"], "--at sigma: is given twice, 1 and 1.5; "),
    ([*MAP, "--at", "sigma=1=2"], "--at sigma=1=2: must be KEY=VALUE"),
    ([*MAP, "--at", "sigma"], "--at sigma: must be KEY=VALUE"),
    ([*MAP, "--metric", "nmze"], "There is no metric 'nmze'. Did you mean 'nmse'?"),
    ([*MAP, "--out", "x.gif"], "x.gif: can't be written: a picture ends in .png, .pdf, .svg"),
    ([*MAP, "--out", "no/x.png"], "no/x.png: can't be written: No such file or directory"),
    (["plot", "cube.zarr"], "Name the horizontal axis: `--x` one of K0, Td, sigma."),
    (["plot", "cube.zarr", "--x", "Kenv"], "'Kenv' does not vary here: it is 200 N*m/rad."),
    (["plot", "design.zarr", "--x", "K0", "--y", "Td"], "'Td' does not vary here: it is 5 N*m."),
    (["plot", "design.zarr", "--x", "K0", "--at", "scenario=3"], "drawn as an axis"),
    (["history", "cube.zarr", "--at", "Kenv=5"], "'Kenv' does not vary here"),
    (["history", "cube.zarr", "--at", "Td=50"], "Td = 50 lies outside the sweep"),
    (["history", "cube.zarr", "--at", "Td=1,2,4,10", "K0=10,100"], "8 cells are too many"),
    (["history", "design.zarr", "--at", "K0=5"], "'K0' varies along 'scenario'"),
    (["history", "design.zarr", "--at", "scenario=16"], "covers 0 to 15."),
    (["history", "design.zarr", "--at", "scenario=1.5"], "scenario = 1.5 is no index of the sweep"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_a_wrong_request_gets_one_line_and_writes_nothing(there, arguments, message):
    done = typed(*arguments)
    assert (done.code, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert message in done.stderr
    assert written(there) == []


def test_a_random_design_is_drawn_over_its_fields(there):
    assert typed("plot", "design.zarr", "--x", "K0").stdout == "wrote design-nmse-K0.png\n"
    done = typed("plot", "design.zarr", "--x", "K0", "--y", "Kenv", "--metric", "nmse_tail")
    assert done.stdout == "wrote design-nmse_tail-K0-Kenv.png\n"


@pytest.fixture
def drawn(monkeypatch):
    """The figures that commands save."""
    figures = []
    monkeypatch.setattr(output, "_save", lambda figure, *_: figures.append(figure))
    return figures


def test_history_runs_the_cells_of_a_store_again(there, drawn):
    """With its model, its dt and its parameters: the torque has the peak that the store has."""
    done = typed("history", "cube.zarr", "--at", "K0=10,100", "Td=4", "sigma=1.25")
    assert (done.code, done.stderr) == (0, "")
    torque = drawn[0].axes[0]
    curves = [line.get_ydata() for line in torque.lines if len(line.get_xdata()) == 20]
    with xr.open_zarr("cube.zarr") as data:
        peaks = data["peak_torque"].sel(Td=4.0, sigma=1.25)
        # the largest torque of the steps' ends: a start from rest has no peak but its end
        assert [np.abs(T).max() for T in curves] == pytest.approx(peaks.values, rel=1e-5)
    labels = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert labels[:2] == ["$K_0$ = 10 N·m/rad", "$K_0$ = 100 N·m/rad"]
    assert "$T_d$ = 4 N·m" in drawn[0].get_suptitle()


def test_history_of_a_scenario_of_a_random_design(there, drawn):
    assert typed("history", "design.zarr", "--at", "scenario=3,5").code == 0
    assert len(drawn[0].legends[0].get_texts()) == 3


RC = """
text.usetex: True
figure.autolayout: True
savefig.bbox: tight
savefig.pad_inches: 2
savefig.transparent: True
savefig.facecolor: red
font.family: serif
font.size: 30
mathtext.fontset: stix
axes.grid: True
axes.prop_cycle: cycler('color', ['r'])
axes.xmargin: 0.4
axes.formatter.use_locale: True
axes.unicode_minus: False
lines.marker: o
image.cmap: jet
legend.loc: upper left
svg.fonttype: none
svg.hashsalt: other
pdf.fonttype: 42
path.sketch: 1, 100, 2
hatch.linewidth: 5
backend: TkAgg
"""


def test_pictures_are_the_same_bytes_whatever_the_users_settings(there):
    """`text.usetex` was a traceback, `savefig.bbox` another picture."""
    commands = [
        [*MAP, "--at", "sigma=1.25"],
        ["plot", "cube.zarr", "--x", "K0", "--at", "Td=4,sigma=1.25"],
        ["plot", "design.zarr", "--x", "K0", "--y", "Kenv"],
        ["history", "cube.zarr", "--at", "K0=10,100", "Td=4,10", "sigma=1.25"],
    ]
    (there / "user").mkdir()
    (there / "user" / "matplotlibrc").write_text(RC)
    (there / "locked").write_text("a file where a folder should be")
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("MPL", "MATPLOTLIB"))}
    plain.pop("DISPLAY", None)
    users = plain | {
        "MATPLOTLIBRC": str(there / "user" / "matplotlibrc"),
        "MPLBACKEND": "TkAgg",
    }
    odd = plain | {"MPLBACKEND": "no-such-backend", "MPLCONFIGDIR": str(there / "locked" / "x")}
    for i, command in enumerate(commands):
        suffix = ("png", "svg", "pdf", "png")[i]
        environments = {"plain": plain, "users": users} | ({"odd": odd} if i == 0 else {})
        for name, environment in environments.items():
            file = f"{i}-{name}.{suffix}"
            call(*command, "--out", file, code=0, folder=there, environment=environment)
        for name in environments:
            assert (there / f"{i}-{name}.{suffix}").read_bytes() == (
                there / f"{i}-plain.{suffix}"
            ).read_bytes(), name


def test_settings_that_matplotlib_cannot_read_are_named(there):
    (there / "matplotlibrc").write_bytes(b"font.family: caf\xe9\n")
    done = call(*MAP, code=2, folder=there)
    assert done.stderr.splitlines()[-1].startswith(
        "fic-sweep: matplotlib can't read its settings, a matplotlibrc in this folder"
    )
    assert written(there) == ["matplotlibrc"]
