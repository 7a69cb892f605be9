"""A wrong sweep file: one clear line that names file, key, value and what would be right."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fic_jax import Params
from sweeps.cli import LIBRARY
from sweeps.plan.grid import MAX_BLOCKS, Grid
from sweeps.runner import warnings_of
from sweeps.spec.reading import load, parse
from sweeps.spec.types import SweepError

GOOD = 'name = "a"\n[axes]\nK0 = { log = [1.0, 1000.0], n = 4 }\n'
SAMPLE = 'name = "a"\n[sample]\nn = 9\n'

WRONG = {
    "foo = 1\n" + GOOD: "unknown key `foo`; known are name, description",
    GOOD + "K00 = [1.0]": "unknown key `axes.K00`; did you mean `K0`?",
    GOOD + "kenv = [1.0]": "unknown key `axes.kenv`; did you mean `Kenv`?",
    GOOD + "[constants]\ndenv = 1": "unknown key `constants.denv`; did you mean `Denv`?",
    GOOD + "[model]\nlaws = 'effort'": "unknown key `model.laws`; did you mean `law`?",
    GOOD + "[time]\ndT = 0.1": "unknown key `time.dT`; did you mean `dt`?",
    GOOD
    + 'Kenv = "x"': "`axes.Kenv` must be a list of numbers or a range such as { log = [1, 100]",
    GOOD + 'Kenv = ["x", 1]': '`axes.Kenv.0` must be a number, but is "x".',
    GOOD + '[constants]\nTd = "5"': '`constants.Td` must be a number, but is "5".',
    GOOD + "Kenv = [true]": "`axes.Kenv.0` must be a number, but is true.",
    GOOD + "Kenv = []": "`axes.Kenv` must be not empty, but is [].",
    GOOD + "Kenv = [nan]": "`axes.Kenv.0` must be a finite number, but is NaN.",
    GOOD + "[constants]\nTd = inf": "`constants.Td` must be a finite number, but is Infinity.",
    GOOD + "I = [-1, 2]": "`axes.I` must be positive and finite, but is -1.",
    GOOD + "Kenv = [-1.0]": "`axes.Kenv` must be non-negative and finite, but is -1.",
    GOOD + "Td = [0, 1]": "`axes.Td` must be non-zero and finite, but is 0.",
    GOOD + "[constants]\nxb = 0.1": "`xb` must be greater than x0 = 0.1, but is 0.1.",
    GOOD + "x0 = [0.05, 0.2]": "`xb` must be greater than x0 = 0.2, but is 0.11 (the default).",
    GOOD + "[cases]\nx0 = [0.1, 0.3]\nxb = [0.2, 0.25]": "`xb` must be greater than x0 = 0.3",
    GOOD
    + "period = [0.015]": "`axes.period` must be a whole multiple of dt = 0.01 s (nearest: 0.02)",
    GOOD + "period = [1e308]": "`axes.period` must be at most 2,147,483,647 steps of dt, but is 1e",
    GOOD + "[time]\ndt = 0.3": "`time.t_end` must be a whole multiple of dt = 0.3 s (nearest: 9.9)",
    GOOD + "[time]\ndt = -1": "`time.dt` must be greater than 0, but is -1.",
    GOOD + "K0 = [1.0, 2.0]": "not valid TOML: a key is given twice",
    GOOD + "[constants]\nK0 = 3.0": "`axes.K0` must be given once, but is in `constants` too.",
    GOOD + "[cases]\nK0 = [1.0]": "`cases.K0` must be given once, but is in `axes` too.",
    GOOD + "Td = [1.0, 1.0]": "`axes.Td` must be values that differ, but some are given twice.",
    GOOD + "[cases]\nDenv = [1, 2]\nKenv = [1, 2, 3]": "`cases` must be columns of equal length",
    GOOD + "Td = { log = [1, 2], lin = [1, 2], n = 4 }": "either log = [a, b] or lin = [a, b]",
    GOOD + "Td = { log = [0, 2], n = 4 }": "must be between positive ends on a log scale",
    GOOD + "Td = { lin = [2, 2], n = 4 }": "must be between two different ends",
    GOOD + "Td = { log = [1, 2], n = 0 }": "`axes.Td.n` must be greater than or equal to 2",
    GOOD + "Td = { log = [1, 2] }": "`axes.Td.n` must be given, but is missing.",
    GOOD + "Td = { log = [1, 2], n = 10000000000 }": "`axes.Td.n` must be less than or equal to",
    GOOD + '[model]\nlaw = "effrt"': "`model.law` must be one of algorithm1, effort, energy",
    GOOD + '[model]\nlaw = ["energy", "energy"]': "`model.law` must be choices that differ",
    GOOD + "[model]\nlaw = 3": "`model.law` must be a text in quotes, but is 3.",
    GOOD + '[model]\nintegrator = "rk45"': "`model.integrator` must be one of rk4",
    GOOD + "[sample]\nn = 10\nranges = { Td = { lin = [1, 2] } }": "instead of `axes`",
    SAMPLE + "ranges = { period = { lin = [1, 2] } }": "must be an axis or a case",
    SAMPLE + 'method = "sobl"\nranges = { Td = { lin = [1, 2] } }': "'sobol', 'lhs' or 'random'",
    'name = "a"': "`axes` must name at least one quantity to sweep, but is empty.",
    'name = "a/b"\n[axes]\nK0 = [1.0]': "`name` must be letters, digits",
    "[axes]\nK0 = [1.0]": "`name` must be given, but is missing.",
    'metrics = ["nms"]\n' + GOOD: "unknown metric `nms`; did you mean `nmse`?",
    "error_estimate = 1\n" + GOOD: "`error_estimate` must be true or false, but is 1.",
    "x = ": "not valid TOML",
    "name = " + "[" * 5000: "not valid TOML",
}


@pytest.mark.parametrize(("text", "message"), WRONG.items())
def test_wrong_file_gets_one_clear_line(text, message):
    with pytest.raises(SweepError) as caught:
        parse(text, "mine.toml")
    told = str(caught.value)
    assert told.startswith("mine.toml: ")
    assert message in told
    assert "\n" not in told


def test_two_mistakes_get_a_line_each():
    with pytest.raises(SweepError) as caught:
        parse('name = 3\n[axes]\nK0 = ["a"]', "mine.toml")
    assert len(str(caught.value).splitlines()) == 2


def test_every_wrong_value_gets_a_line():
    with pytest.raises(SweepError) as caught:
        parse(GOOD + "I = [-1.0]\nTd = [0.0]\nKenv = [-2.0]", "mine.toml")
    assert len(str(caught.value).splitlines()) == 3


@pytest.mark.parametrize("text", ["time = 5\n", "constants = 3\n", "sample = 5\n", "axes = 1\n"])
def test_overrides_of_what_is_no_table_are_told(text):
    with pytest.raises(SweepError, match="must be a"):
        parse(text + 'name = "a"', "f", ("dt=0.1", "K0=3", "Td=[1, 2]"))


def test_missing_file(tmp_path):
    with pytest.raises(SweepError, match="there is no such file"):
        load(tmp_path / "none.toml")


def test_sizes_come_from_the_file_alone():
    """10^12 cells are planned without being made."""
    axes = "".join(f"{name} = {{ lin = [1, 9], n = 1000 }}\n" for name in ("K0", "Kenv", "Td"))
    plan = parse('name = "huge"\n[axes]\n' + axes + "I = { lin = [1, 9], n = 1000 }", "f")
    assert Grid(plan).cells == 10**12
    assert Grid(plan).n_blocks <= MAX_BLOCKS


@pytest.mark.parametrize("path", sorted(LIBRARY.glob("*.toml")), ids=lambda p: p.stem)
def test_library_is_valid_and_named_after_its_file(path):
    assert load(path).name == path.stem


def test_atlas_sizes():
    assert Grid(load(LIBRARY / "atlas.toml")).cells >= 10_000_000
    assert Grid(load(LIBRARY / "atlas-small.toml")).cells >= 1_000_000


def test_overrides_move_a_field_to_where_its_value_belongs():
    text = GOOD + "[constants]\nTd = 5.0"
    plan = parse(
        text, "f", ("K0=10", "Td=[1, 2]", "dt=0.005", "law=effort", "sigma={lin=[1,2],n=3}")
    )
    assert plan.constants == {"K0": 10}
    assert list(plan.axes) == ["Td", "sigma"]
    assert plan.time.dt == 0.005
    assert plan.model == {"law": "effort"}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("K0", "--set K0: must be KEY=VALUE, as in --set K0=10"),
        ("k0=3", "unknown key `k0`; did you mean `K0`?"),
        ("K0=x", '`constants.K0` must be a number, but is "x".'),
    ],
)
def test_wrong_override(override, message):
    with pytest.raises(SweepError) as caught:
        parse(GOOD, "f", (override,))
    assert message in str(caught.value)


def test_axis_values_hit_their_ends_exactly():
    values = parse(GOOD, "f").axis_values("K0")
    assert values[0] == 1.0
    assert values[-1] == 1000.0
    odd = parse('name = "a"\n[axes]\nKenv = { lin = [16.821, 1.678], n = 7 }', "f")
    assert odd.axis_values("Kenv")[-1] == 1.678
    np.testing.assert_allclose(values, [1.0, 10.0, 100.0, 1000.0])


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    sides=st.lists(st.integers(2, 9), min_size=1, max_size=4),
    cases=st.integers(0, 4),
    chunk=st.integers(1, 200),
)
def test_blocks_cover_every_cell_once_with_its_own_values(sides, cases, chunk):
    """Each block's columns are the slice of the full grid; blocks fit and don't overlap."""
    names = ["K0", "Kenv", "Denv", "Td"][: len(sides)]
    axes = "".join(
        f"{n} = {{ lin = [1, 7], n = {k} }}\n" for n, k in zip(names, sides, strict=True)
    )
    case = f"[cases]\ngap = {[0.1 * i for i in range(cases)]}\n" if cases else ""
    grid = Grid(
        parse(f'name = "a"\n[model]\ncontact = ["welded", "hard_stop"]\n[axes]\n{axes}{case}', "f"),
        chunk,
    )
    along = [np.linspace(1, 7, k) for k in sides] + ([0.1 * np.arange(cases)] if cases else [])
    full = np.meshgrid(*along, indexing="ij")
    seen = np.zeros(grid.shape, int)
    for block in grid.blocks():
        seen[block] += 1
        params = grid.params(block)
        assert isinstance(params, Params)
        expected = [values[block[1:]].ravel() for values in full]
        for name, values in zip([*names, *(["gap"] if cases else [])], expected, strict=True):
            np.testing.assert_allclose(getattr(params, name), values, rtol=1e-15)
            assert len(values) <= max(chunk, 1)
        assert grid.model(block).contact == ["welded", "hard_stop"][block[0].start]
    assert (seen == 1).all()
    assert len(list(grid.blocks())) == grid.n_blocks


@pytest.mark.parametrize("method", ["sobol", "lhs", "random"])
def test_samples_are_the_same_in_any_stretch(method):
    text = (
        f'name = "a"\n[sample]\nn = 1024\nmethod = "{method}"\nseed = 3\n'
        "ranges = { Td = { lin = [1.0, 5.0] }, K0 = { log = [1.0, 1000.0] } }"
    )
    grid = Grid(parse(text, "f"))
    whole = grid.coordinates("scenario")
    for start, stop in ((0, 1), (1, 6), (337, 411), (1000, 1024)):
        part = grid.coordinates("scenario", slice(start, stop))
        for name in ("Td", "K0"):
            np.testing.assert_array_equal(part[name], whole[name][start:stop])
    assert np.all((whole["Td"] >= 1.0) & (whole["Td"] <= 5.0))
    # mean 3, standard error 4/sqrt(12 n) = 0.036 for random draws, far less for the others
    assert np.mean(whole["Td"]) == pytest.approx(3.0, abs=0.12)
    assert np.mean(np.log10(whole["K0"])) == pytest.approx(1.5, abs=0.1)
    if method == "lhs":
        strata = np.floor((whole["Td"] - 1.0) / 4.0 * 1024)
        assert len(np.unique(strata)) == 1024


def test_warnings_say_how_much():
    stiff = parse('name = "a"\n[axes]\nK0 = [300.0]\nDenv = [10.0, 5000.0]', "f")
    told = list(warnings_of(stiff))
    assert "K0*x0 reaches 2 times Fmax" in told[0]
    # lambda = D/I = 500 1/s, less K/D which is a few 1/s: 5 time constants in 10 ms
    assert "dt = 0.01 s is 4." in told[1] or "dt = 0.01 s is 5" in told[1]
    assert "unstable" in told[1]
    assert not list(warnings_of(parse('name = "a"\n[axes]\nK0 = [50.0, 100.0]', "f")))
