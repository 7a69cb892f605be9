"""`--set KEY=VALUE` changes one key of a sweep file; a wrong value is refused as in the file."""

import re
import shlex

import pytest

from sweeps.spec.mistakes import SweepError
from sweeps.spec.overrides import refuse_repeated
from sweeps.spec.reading import parse

FILE = """
name = "a"
[constants]
Td = 5.0
[axes]
K0 = { log = [1.0, 1000.0], n = 4 }
Kenv = [1.0, 2.0]
"""
DRAWN = 'name = "a"\n[sample]\nn = 9\nranges = { Td = { lin = [1, 2] }, K0 = { lin = [1, 2] } }\n'


def test_a_field_moves_to_the_table_of_its_new_value():
    sweep = parse(FILE, "f", ("K0=10", "Td=[1, 2]", "sigma={lin=[1,2],n=3}", "Kenv=[3, 4]"))
    assert sweep.constants == {"K0": 10}
    assert list(sweep.axes) == ["Kenv", "Td", "sigma"]  # an axis that stays one keeps its place
    assert sweep.axes["Kenv"] == [3, 4]
    cases = parse(FILE + "[cases]\ngap = [0.0, 0.1]", "f", ("gap=0.2",))
    assert (cases.cases, cases.constants["gap"]) == ({}, 0.2)
    drawn = parse(DRAWN, "f", ("Td=3",))
    assert (list(drawn.sample.ranges), drawn.constants) == (["K0"], {"Td": 3})


def test_words_need_no_quotes():
    sweep = parse(FILE, "f", ("law=[effort, energy]", "metrics=[nmse]", "contact=welded"))
    assert sweep.model == {"law": ["effort", "energy"], "contact": "welded"}
    assert sweep.metrics == ["nmse"]


def test_other_keys_need_no_table():
    settings = ("dt=0.005", "law=effort", "name=b", "error_estimate=true", "precision=64")
    sweep = parse(FILE, "f", settings)
    assert sweep.time.dt == 0.005
    assert sweep.model == {"law": "effort"}
    assert (sweep.name, sweep.error_estimate, sweep.bits) == ("b", True, 64)
    drawn = parse(DRAWN, "f", ("n=7", "method=lhs", "seed=3")).sample
    assert (drawn.n, drawn.method, drawn.seed) == (7, "lhs", 3)


@pytest.mark.parametrize(
    ("value", "wanted"),
    [
        ("K0", "--set K0: must be KEY=VALUE, as in --set K0=10"),
        ("=3", "--set =3: must be KEY=VALUE, as in --set K0=10"),
        ("k0=3", "unknown key `k0`; did you mean `K0` (constant stiffness of"),
        ("K0=x", "--set K0=x: `K0` must be a number, a list or a range (lin or log), as in --set"),
        ("K0='x'", "--set K0='x': `K0` must be a number, a list or a range"),
        ("K0=" + "[" * 100_000, "`K0` must be a number"),
        ("K0=" + "9" * 5000, "`K0` must be a number"),
        ("rate=1000", "did you mean `period` (control period of the exploration, in s)?"),
        ("inertia=0.05", "did you mean `I` (inertia, in kg*m^2)?"),
        (
            "stiffness=5",
            "did you mean `K0` (constant stiffness of the controller, in N*m/rad) or `",
        ),
        ("time.dt=0.005", "unknown key `time.dt`; did you mean `dt`?"),
        ("K0={ lin = [1, 9], n = 10000000000 }", "`axes.K0.n` must be less than or equal to"),
        ("name=../../x", "`name` must be letters, digits"),
        ("metrics=['../x']", "unknown metric `../x`"),
        ("a\nb=1", r"--set a\nb=1: unknown key `a\nb`"),
        ("\x1b[2J", r"--set \x1b[2J: must be KEY=VALUE"),
        ("k" * 100_000, "--set kkk"),
        ("K0=nan", "`constants.K0` must be a finite number"),
        ("t_end=1e300", "`time.t_end` must be at most 100,000,000 steps"),
        ("dt=1ms", 'f with --set: `time.dt` must be a number, but is "1ms".'),
        ("precision=16", "`precision` must be 32 or 64, but is 16."),
        ("precision=true", "`precision` must be 32 or 64, but is true."),
        ("precision='64'", '`precision` must be 32 or 64, but is "64".'),
        ("seed=1", "`sample.n` must be given"),
        ("law=\udcff", "`model.law` must be"),
    ],
)
def test_a_wrong_value_is_refused(value, wanted):
    with pytest.raises(SweepError) as refusal:
        parse(FILE, "f", (value,))
    assert wanted in str(refusal.value)
    assert len(str(refusal.value)) < 2_000
    assert all(line.isprintable() for line in str(refusal.value).splitlines())


@pytest.mark.parametrize("text", ["time = 5\n", "constants = 3\n", "sample = 5\n", "axes = 1\n"])
def test_a_wrong_table_stays_wrong(text):
    with pytest.raises(SweepError, match="must be a"):
        parse(text + 'name = "a"', "f", ("dt=0.1", "K0=3", "Td=[1, 2]"))


@pytest.mark.parametrize(
    ("value", "number"),
    [("1.", 1.0), (".5", 0.5), ("-1.", -1.0), ("1.e2", 100.0), ("+.5e-1", 0.05), ("1e3", 1000.0)],
)
def test_a_number_may_be_written_as_python_does(value, number):
    assert parse(FILE, "f", (f"Td={value}",)).constants["Td"] == number
    assert parse(FILE, "f", (f"Td=[{value}, 7.]",)).axes["Td"] == [number, 7.0]


@pytest.mark.parametrize("value", ["300-3000", "300:3000", "300..3000", "300, 3000", "(300,3000)"])
def test_the_message_about_a_range_shows_one_that_works(value):
    with pytest.raises(SweepError) as refusal:
        parse(FILE, "f", (f"Kenv={value}",))
    commands = re.findall(r"--set ('Kenv=.*?')", str(refusal.value))
    axes = [parse(FILE, "f", tuple(shlex.split(text))).axis_values("Kenv") for text in commands]
    assert [(axis[0], axis[-1], len(axis)) for axis in axes] == [(300, 3000, 2), (300, 3000, 16)]


def test_all_wrong_settings_are_named_at_once():
    with pytest.raises(SweepError) as refusal:
        parse(FILE, "f", ("K0=abc", "Td=3", "foo=1"))
    assert [line.split(":")[0] for line in str(refusal.value).splitlines()] == [
        "--set K0=abc",
        "--set foo=1",
    ]


def test_a_key_set_twice_is_refused():
    with pytest.raises(SweepError, match="--set K0=20: `K0` must be set once"):
        refuse_repeated(("K0=10", "Td=3", "K0=20"))
