"""Each mistake in a sweep file gets a line: file, key, value, what would be right."""

import re

import pytest

from fic_jax import CHOICES, QUANTITIES
from sweeps.spec.mistakes import SweepError, hint
from sweeps.spec.reading import parse
from sweeps.spec.rules import out_of_bounds
from sweeps.spec.types import STORED, Reduction, Refinement, Sweep, Time

GOOD = 'name = "a"\n[axes]\nK0 = { log = [1.0, 1000.0], n = 4 }\n'
SAMPLE = 'name = "a"\n[sample]\nn = 9\n'

WRONG = {
    "foo = 1\n" + GOOD: "unknown key `foo`; known are name, description",
    GOOD + "K00 = [1.0]": "unknown key `axes.K00`; did you mean `K0` (",
    GOOD + "kenv = [1.0]": "unknown key `axes.kenv`; did you mean `Kenv` (",
    GOOD + "[constants]\ndenv = 1": "unknown key `constants.denv`; did you mean `Denv` (",
    GOOD + "[model]\nlaws = 'effort'": "unknown key `model.laws`; did you mean `law`?",
    GOOD + "[time]\ndT = 0.1": "unknown key `time.dT`; did you mean `dt`?",
    GOOD
    + 'Kenv = "x"': "`axes.Kenv` must be a list of numbers or a range such as { log = [1, 100]",
    GOOD + 'Kenv = ["x", 1]': 'value 1 of `axes.Kenv` must be a number, but is "x".',
    GOOD + '[constants]\nTd = "5"': '`constants.Td` must be a number, but is "5".',
    GOOD + "Kenv = [true]": "value 1 of `axes.Kenv` must be a number, but is true.",
    GOOD + "Kenv = []": "`axes.Kenv` must be not empty, but is [].",
    GOOD + "Kenv = [nan]": "value 1 of `axes.Kenv` must be a finite number, but is NaN.",
    GOOD + "[constants]\nTd = inf": "`constants.Td` must be a finite number, but is Infinity.",
    GOOD + "I = [-1, 2]": "`axes.I` must be positive and finite, but is -1.",
    GOOD + "Kenv = [-1.0]": "`axes.Kenv` must be non-negative and finite, but is -1.",
    GOOD + "Td = [0, 1]": "`axes.Td` must be non-zero and finite, but is 0.",
    GOOD + "[constants]\nxb = 0.1": "`xb` must be greater than x0 = 0.1, but is 0.1.",
    GOOD + "x0 = [0.05, 0.2]": "`xb` must be greater than x0 = 0.2, but is 0.11 (the default).",
    GOOD + "x0 = [0.05, 0.1]\nxb = [0.08, 0.2]": "`xb` must be greater than x0 = 0.1, but is 0.08.",
    SAMPLE + "ranges = { x0 = { lin = [0.05, 0.1] }, xb = { lin = [0.08, 0.2] } }": "x0 = 0.1, but",
    GOOD + "[cases]\nx0 = [0.1, 0.3]\nxb = [0.2, 0.25]": "`xb` must be greater than x0 = 0.3",
    GOOD
    + "period = [0.015]": "`axes.period` must be a whole multiple of dt = 0.01 s (nearest: 0.02)",
    GOOD + "period = { lin = [0.01, 0.02], n = 3 }": "whole multiple of dt = 0.01 s (nearest: 0.02",
    GOOD + "[cases]\nperiod = [0.01, 0.025]": "`cases.period` must be a whole multiple of dt",
    GOOD + "period = [1e308]": "`axes.period` must be at most 2,147,483,647 steps of dt, but is 1e",
    GOOD + "[time]\ndt = 0.3": "`time.t_end` must be a whole multiple of dt = 0.3 s (nearest: 9.9)",
    GOOD + "[time]\ndt = -1": "`time.dt` must be greater than 0, but is -1.",
    GOOD + "K0 = [1.0, 2.0]": "not valid TOML: a key is given twice",
    GOOD + "[constants]\nK0 = 3.0": "`axes.K0` must be given once, but is in `constants` too.",
    GOOD + "[cases]\nK0 = [1.0]": "`cases.K0` must be given once, but is in `axes` too.",
    GOOD + "Td = [1.0, 1.0]": "`axes.Td` must be values that differ, but some are given twice.",
    GOOD
    + "Td = [0.3, 1, 0.30000000000000004]": "`axes.Td` must be values that differ, but some are",
    GOOD + "[time]\nprecision = 64": "`time.precision` must stand at the top, before any [table].",
    GOOD + "[model]\nTd = 5": "`model.Td` must stand in [constants] or in [axes] or in [cases].",
    GOOD + "contact = [1]": "`axes.contact` must stand in [model].",
    GOOD + "[constants]\nt_end = 3.0": "`constants.t_end` must stand in [time].",
    "dt = 0.1\n" + GOOD: "`dt` must stand in [time].",
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
    'metrics = ["nms"]\n' + GOOD: "unknown metric `nms`; did you mean `nmse` or `nmse_tail`?",
    "error_estimate = 1\n" + GOOD: "`error_estimate` must be true or false, but is 1.",
    "x = ": "not valid TOML",
    "name = " + "[" * 5000: "not valid TOML",
}


@pytest.mark.parametrize(("text", "message"), WRONG.items())
def test_a_mistake_gets_one_clear_line(text, message):
    with pytest.raises(SweepError) as refusal:
        parse(text, "mine.toml")
    line = str(refusal.value)
    assert line.startswith("mine.toml: ")
    assert message in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ('name = 3\n[axes]\nK0 = ["a"]', 2),  # wrong types
        (GOOD + "I = [-1.0]\nTd = [0.0]\nKenv = [-2.0]", 3),  # out of bounds
        (GOOD + "[cases]\nK0 = [1.0]\nTd = [1.0, 2.0]", 2),  # wrong places
        (  # of every kind at once: types, unknown names, places, bounds, the time grid
            "foo = 1\n"
            + GOOD
            + 'Kenv = "x"\nI = [-1.0]\nk1 = [1.0]\n[constants]\nK0 = 3.0\nTd = 0.0\nxb = "0.2"\n'
            + '[model]\nlaw = "effrt"\n[time]\ndt = 0.3',
            9,
        ),
        ('name = 3\n[time]\ndt = "x"\n[axes]\nperiod = [0.002]', 2),  # dt is not known
        ('name = "a"\n[time]\ndt = -1.0\n[axes]\nK0 = ["a"]', 2),  # an axis was meant
        ('name = "a"\n[sample]\nranges = { Td = 3 }\n[constants]\nI = -1.0', 3),
        # a wrong type in a table, and what its other keys name
        (GOOD + '[refine]\nlevels = "x"\naxes = ["Td"]\nclasses = ["nms < 1"]\nabsolute = 3', 4),
        (GOOD + "[refine]\nlevels = 1\nclasses = 3\nrelative = { nms = 1 }\nbudget = 1", 3),
        (GOOD + "[refine]\nlevels = 1\nabsolute = { nmse = -1, nms = 1 }", 2),
        (GOOD + "[refine]\nlevels = 1.5", 1),
        (GOOD + '[reduce]\nover = 3\nmax = ["nms"]\nshare = { a = "nms < 1" }', 3),
        (GOOD + 'Td = [1, 2]\n[reduce]\nover = ["Te"]\nmax = 3\nbest = "x"', 4),
        (GOOD + 'Td = [1, 2]\n[reduce]\nover = ["Td"]\nquantiles = { nmse = 3, nms = [1] }', 2),
        # what follows from a wrong type is no mistake of its own
        ('name = "a"\n[axes]\nK0 = "x"\n[refine]\nlevels = 1\naxes = ["K0"]', 1),
        ('name = "a"\n[axes]\nK0 = "x"\nTd = [1]\n[reduce]\nover = ["K0"]\nmax = ["nmse"]', 1),
        (GOOD + '[time]\ndt = "x"\nt_end = 0.015', 1),
    ],
)
def test_each_mistake_gets_a_line(text, lines):
    with pytest.raises(SweepError) as refusal:
        parse(text, "mine.toml")
    assert len(str(refusal.value).splitlines()) == lines


@pytest.mark.parametrize(
    ("axis", "line"),
    [
        ("I = [1e-50, 1.0]", "`axes.I` must be positive and finite, but is 0."),
        ("K0 = [1e300, 1.0]", "`axes.K0` must be positive and finite, but is inf."),
        ("xb = [0.1000000001]", "`xb` must be greater than x0 = 0.1, but is 0.1."),
    ],
)
def test_a_value_must_keep_its_bound_in_the_precision_of_the_store(axis, line):
    sweep = parse(f'name = "a"\n[axes]\n{axis}', "mine.toml")
    assert list(out_of_bounds(sweep, "float64")) == []
    assert list(out_of_bounds(sweep, "float32")) == [line]


def axes(last):
    fields = {"K0": 1000, "Kenv": 1000, "Td": 1000, "I": last}
    lines = (f"{name} = {{ lin = [1, 9], n = {n} }}" for name, n in fields.items())
    return 'name = "a"\n[axes]\n' + "\n".join(lines)


def periods(n):
    return f'name = "a"\n[axes]\nperiod = {{ lin = [0.01, {n / 100}], n = {n} }}'


@pytest.mark.parametrize(
    ("largest", "too_large", "message"),
    [
        (axes(1000), axes(1001), "at most 1,000,000,000,000 scenarios, but has 1001000000000."),
        (periods(1_000_000), periods(1_000_001), "`axes.period.n` must be at most 1,000,000"),
        (
            *(
                f'{SAMPLE[:-2]}{n}\nmethod = "lhs"\nranges = {{ Td = {{ lin = [1, 2] }}, '
                "K0 = { lin = [1, 2] } }"
                for n in (5_000_000, 5_000_001)
            ),
            "`sample.n` must be at most 5,000,000 with lhs",
        ),
        (
            *(f"{GOOD}[time]\ndt = 1e-6\nt_end = {t_end}" for t_end in ("100.0", "100.000001")),
            "`time.t_end` must be at most 100,000,000 steps of dt",
        ),
        (
            *(f"{GOOD}[cases]\ngap = {[0.0] * n}" for n in (10_000, 10_001)),
            "`cases.gap` must be at most 10000 values long",
        ),
    ],
    ids=["cells", "periods", "lhs", "steps", "cases"],
)
def test_a_size_may_reach_its_limit(largest, too_large, message):
    parse(largest, "mine.toml")
    with pytest.raises(SweepError, match=re.escape(message)):
        parse(too_large, "mine.toml")


def test_every_stored_metric_may_be_named():
    """The limit of a list's length leaves room for all of them."""
    assert parse(f"metrics = {list(STORED)}\n" + GOOD, "f").metrics == list(STORED)


FIELDS = list(QUANTITIES)
KEYS = list(Sweep.model_fields)


@pytest.mark.parametrize(
    ("word", "known", "meant"),
    [
        ("kenv", FIELDS, ["Kenv"]),
        ("K_env", FIELDS, ["Kenv"]),
        ("K", FIELDS, ["K0"]),
        ("Den", FIELDS, ["Denv"]),
        ("vinit", FIELDS, ["v_init"]),
        ("init", FIELDS, ["x_init", "v_init"]),
        ("stiffness", FIELDS, ["K0", "Kenv"]),
        ("mass", FIELDS, ["I"]),
        ("nmse", FIELDS, []),
        ("conv", FIELDS, []),
        ("level", FIELDS, []),
        ("nmsee", STORED, ["nmse"]),
        ("mse", STORED, ["nmse"]),
        ("error", STORED, ["steady_error"]),
        ("peak", STORED, ["peak_torque"]),
        ("conv", [*STORED, *FIELDS], ["convergence_time"]),
        ("lost", STORED, ["contact_lost"]),
        ("contact_loss", STORED, ["contact_lost"]),
        ("contact", STORED, ["contact_time", "contact_lost"]),
        ("settles", STORED, []),
        ("K0", STORED, []),
        ("nms", STORED, ["nmse", "nmse_tail"]),
        ("k3", FIELDS, ["K0"]),
        ("metric", KEYS, ["metrics"]),
        ("axis", KEYS, ["axes"]),
        ("const", KEYS, ["constants"]),
        ("prec", KEYS, ["precision"]),
        ("bits", KEYS, ["precision"]),
        ("lvels", Refinement.model_fields, ["levels"]),
        ("max_runs", Refinement.model_fields, []),
        ("class", Refinement.model_fields, ["classes"]),
        ("maximum", Reduction.model_fields, ["max"]),
        ("n_steps", Reduction.model_fields, []),
        ("tend", Time.model_fields, ["t_end"]),
        ("steps", Time.model_fields, []),
        ("contakt", CHOICES, ["contact"]),
        ("solver", CHOICES, []),
        ("boundary", ["atlas", "convergence-boundary"], ["convergence-boundary"]),
        ("atlsa", ["atlas", "convergence-boundary"], ["atlas"]),
    ],
)
def test_a_hint_is_near_or_there_is_none(word, known, meant):
    said = hint(word, known)
    named = re.findall("`(.*?)`", said) if "did you mean" in said else []
    assert named == meant, said
