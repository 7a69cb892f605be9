"""Any text is a sweep or is refused in clear lines, with work in proportion to its length.

`FIC_SWEEP_TORTURE=1 pytest -s tests/spec/test_any_file.py` tries 12,000 files instead of 400.
"""

import json
import os
import random
import re
import string
import subprocess
import sys

import pytest
import scipy.stats  # noqa: F401  its import executes five million lines: no file's fault

from fic_jax import CHOICES, QUANTITIES
from sweeps import LIBRARY
from sweeps.cli.messages import plan_lines
from sweeps.plan.grid import MAX_BLOCKS, Grid
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import MAX_FILE, MAX_MISTAKES, load, parse, validate
from sweeps.spec.rules import out_of_bounds
from sweeps.spec.types import COUPLED, MAX_CELLS
from sweeps.spec.warnings import warnings_of
from sweeps.store.format import size
from tests.effort import lines_executed
from tests.torture import TORTURE, many

FILES, RECORDS = many(400, 12_000), many(300, 5_000)
# Python lines that a file may cost: the TOML reader executes up to 23 for each letter, and the
# 1,000 keys that a file may have cost up to 1,000 each to explain.
LINES_PER_LETTER, LINES_FOR_KEYS = 30, 1_000_000
SOBOL_START = 10_000_000  # first scenario of a block that a Sobol sequence reaches without a wait


def is_sweep(text, overrides=()):
    """Whether a text is a sweep that can be planned; if not, the refusal must be clear."""
    try:
        sweep = parse(text, "mine.toml", overrides)
    except SweepError as refusal:
        lines = str(refusal).splitlines()
        assert 1 <= len(lines) <= MAX_MISTAKES + 1
        for line in lines:
            assert line.startswith(("mine.toml: ", "mine.toml with --set: ", "--set "))
            assert line.isprintable()
            assert len(line) < 1_000
        return False
    plan(sweep)
    return True


def plan(sweep):
    """Do all that is done with a sweep before its first scenario runs."""
    grid = Grid(sweep)
    assert 1 <= grid.cells <= MAX_CELLS
    assert grid.n_blocks <= MAX_BLOCKS
    assert size(grid, "float64") > grid.cells
    assert all(line.isprintable() for line in plan_lines(grid, "float32"))
    list(warnings_of(sweep))
    list(out_of_bounds(sweep, "float32"))
    small = Grid(sweep, max(50, 4 * grid.cells // MAX_BLOCKS))
    for index in {0, small.n_blocks - 1}:
        block = small.block(index)
        if not sweep.sample or block[-1].start < SOBOL_START:
            small.params(block)
        small.model(block)
    again = json.loads(sweep.record()) | {"error_estimate": sweep.error_estimate}
    again |= {"precision": sweep.precision} if sweep.precision else {}
    assert validate(again, "a store") == sweep  # a store that is begun can be opened again


def affordable(lines, text):
    return lines < LINES_PER_LETTER * len(text) + LINES_FOR_KEYS


CORPUS = [path.read_text(encoding="utf-8") for path in sorted(LIBRARY.glob("*.toml"))] + [
    """
name = "all"
description = "every table"
metrics = ["nmse", "peak_torque"]
error_estimate = true
precision = 64
[time]
dt = 0.01
t_end = 0.5
[model]
contact = ["welded", "hard_stop"]
law = "effort"
[constants]
sigma = 0.02
[axes]
K0 = { log = [1.0, 300.0], n = 5 }
Kenv = { lin = [-0.0, 300.0], n = 7 }
Td = [-1.0, 5.0, 20.0]
[cases]
Denv = [0.0, 63.2]
gap = [0.0, 0.1]
[reduce]
over = ["case", "Td"]
max = ["nmse"]
quantiles = { nmse = [0.5, 0.95] }
share = { calm = "nmse < 1e-3 and Td > 0" }
best = "K0"
by = "peak_torque"
untrusted = 0.1
""",
    """
name = "refined"
[axes]
K0 = { log = [1.0, 300.0], n = 5 }
Td = [1.0, 5.0]
[refine]
levels = 3
axes = ["K0"]
budget = 50
classes = ["nmse < 0.01", "convergence_time < inf"]
absolute = { overshoot = 0.1 }
relative = { peak_torque = 0.5 }
""",
    """
name = "drawn"
[sample]
n = 1000
method = "lhs"
seed = 7
ranges = { Td = { lin = [1.0, 5.0] }, K0 = { log = [1.0, 1000.0] } }
[axes]
""",
    'name = "axes"\naxes = { period = { lin = [0.01, 0.1], n = 10 }, x0 = [0.05, 0.1] }\n',
]
KEYS = [
    *QUANTITIES, *CHOICES, "name", "description", "metrics", "error_estimate", "precision", "dt",
    "t_end", "n", "method", "seed", "ranges", "lin", "log", "time", "model", "constants", "axes",
    "cases", "sample", "case", "scenario", "status", "trusted", "nmse", '""', '"a b"', "'é'",
    "'../x'", '"\\u0000"', '"a\\nb"', "__class__", "k" * 500,
]  # fmt: skip
VALUES = [
    "0", "-0.0", "1", "-1", "0.3", "2", "10", "1e-320", "1e308", "-1e308", "1e999", "nan", "-inf",
    "inf", "1e15", "10000000", "4294967296", "9223372036854775807", "9" * 400, "1" * 5000,
    "0x" + "f" * 6000, "1_000", "0b11", "true", "false", '""', '"x"', '"welded"', '"sobol"',
    '"lhs"', "'../../etc/passwd'", '"\\u001b[2J"', '"\\u202e"', '"nmse"', "'''\n\n'''",
    '"' + "w" * 3000 + '"', "[]", "[[]]", "{}", "[1, 2]", "[1, 1]", "[2, 'a']", "[1, 2, 3]",
    "[0.0, 1.0]", "[" + "1.5, " * 300 + "]", "{ n = 3 }", "{ lin = [1, 2], n = 3 }",
    "{ log = [1e-300, 1e300], n = 10000000 }", "{ lin = [-1, 1], n = 10000000 }",
    "{ lin = [1.0, 1.0000000000000002], n = 100 }", "{ log = [1, 2] }", "1979-05-27",
    "1979-05-27T07:32:00Z", "07:32:00", '["nmse", "nmse"]', '["hard_stop", "welded"]',
    "[" * 60 + "]" * 60, "{ a = " * 60 + "1" + " }" * 60, "é", "\x00", "=", "",
]  # fmt: skip
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def mutated(text, rng):
    """The text after one to three random changes."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        text = rng.choice(MUTATIONS)(text, rng)
    return text


def _another_number(text, rng):
    found = list(NUMBER.finditer(text))
    if not found:
        return text
    at = rng.choice(found)
    return text[: at.start()] + rng.choice(VALUES) + text[at.end() :]


def _a_near_number(text, rng):
    """A number that may well be allowed."""
    return NUMBER.sub(
        lambda found: found[0] if rng.random() < 0.8 else str(rng.choice((2, 7, 0.5, 31, 1e-3))),
        text,
    )


def _another_value(text, rng):
    lines = text.splitlines()
    at = rng.randrange(len(lines) or 1)
    key = lines[at].partition("=")[0] if lines and "=" in lines[at] else rng.choice(KEYS)
    return "\n".join([*lines[:at], f"{key} = {rng.choice(VALUES)}", *lines[at + 1 :]])


def _another_key(text, rng):
    lines = text.splitlines()
    at = rng.randrange(len(lines) or 1)
    value = lines[at].partition("=")[2] if lines and "=" in lines[at] else rng.choice(VALUES)
    return "\n".join([*lines[:at], f"{rng.choice(KEYS)} = {value}", *lines[at + 1 :]])


def _one_more(text, rng):
    lines = text.splitlines()
    key = ".".join(rng.choices(KEYS, k=rng.choice((1, 1, 1, 2, 3, 30))))
    table = f"[{rng.choice(KEYS)}]" if rng.random() < 0.3 else f"{key} = {rng.choice(VALUES)}"
    lines.insert(rng.randint(0, len(lines)), table)
    return "\n".join(lines)


def _lines(text, rng):
    """Delete a line, repeat it, or swap two."""
    lines = text.splitlines() or [""]
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    how = rng.randrange(3)
    if how == 0:
        del lines[i]
    elif how == 1:
        lines.insert(j, lines[i])
    else:
        lines[i], lines[j] = lines[j], lines[i]
    return "\n".join(lines)


def _letters(text, rng):
    at = rng.randint(0, len(text))
    what = "".join(rng.choices([*string.printable, "é", "\x00", "\u202e", "\U0001f600"], k=3))
    return text[:at] + what + text[at + rng.randrange(4) :]


def _end(text, rng):
    return text[: rng.randint(0, len(text))]


MUTATIONS = (
    _another_number, _a_near_number, _a_near_number, _a_near_number, _another_value,
    _another_key, _one_more, _lines, _letters, _end,
)  # fmt: skip


def random_file(rng):
    """Keys and values of sweep files in any order."""
    lines = [f"{rng.choice(KEYS)} = {rng.choice(VALUES)}" for _ in range(rng.randrange(3))]
    if rng.random() < 0.8:
        lines.append('name = "a"')
    for _ in range(rng.randrange(5)):
        lines.append(f"[{rng.choice(KEYS[-26:] if rng.random() < 0.8 else KEYS)}]")
        lines += [f"{rng.choice(KEYS)} = {rng.choice(VALUES)}" for _ in range(rng.randrange(4))]
    return "\n".join(lines)


def test_any_file_is_a_sweep_or_is_refused_in_clear_lines(tmp_path, capsys):
    rng, counts = random.Random(6), {True: 0, False: 0}
    for i in range(FILES):
        text = random_file(rng) if i % 4 == 0 else mutated(rng.choice(CORPUS), rng)
        overrides = ()
        if i % 5 == 0:
            overrides = (f"{rng.choice(KEYS)}={rng.choice(VALUES)}", mutated("K0 = 10", rng))
        try:
            lines, good = lines_executed(lambda text=text, set_=overrides: is_sweep(text, set_))
            assert affordable(lines, text + "".join(overrides))
            counts[good] += 1
            if i % 10 == 1:
                broken_bytes(tmp_path / "mine.toml", text, rng)
        except Exception as error:
            error.add_note(f"file {i}:\n{text}\n--set {overrides}")
            raise
    assert min(counts.values()) > FILES / 20  # both outcomes are tested
    if TORTURE:
        counted = f"{counts[True]:,} planned, {counts[False]:,} refused"
        with capsys.disabled():
            sys.stdout.write(f"\n{FILES:,} sweep files: {counted}\n")


def broken_bytes(path, text, rng):
    """Load the text after some of its bytes became others, perhaps no UTF-8."""
    content = bytearray(text.encode())
    for _ in range(rng.randint(1, 4)):
        content[rng.randrange(len(content) or 1) : 1] = bytes([rng.randrange(256)])
    path.write_bytes(content)
    refusal = ""
    try:
        plan(load(path))
    except SweepError as error:
        refusal = str(error)
    assert all(line.startswith(f"{path}: ") for line in refusal.splitlines())


ANYTHING = [
    None, True, 0, 1, 2, -1, 1.5, 0.25, 10**400, float("nan"), float("inf"), "", "x", "../x",
    "\x1b[2J\n", "\ud800", [1.0, 2.0], [], [None], [[1]], {}, {"a": None}, {"": {}},
    {"lin": [1, 2], "n": 3}, {"log": None}, [1, "2"],
]  # fmt: skip


def changed(record, rng):
    """The record after one value in it was replaced or added."""
    place = record
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = rng.choice(keys) if keys else None
        inner = place[key] if keys else None
        if not isinstance(inner, dict | list) or not inner or rng.random() < 0.3:
            break
        place = inner
    if isinstance(place, dict) and (key is None or rng.random() < 0.2):
        key = rng.choice(KEYS)
    if key is not None:
        place[key] = rng.choice(ANYTHING)
    return record


def test_any_record_of_a_store_is_a_sweep_or_is_refused_in_clear_lines():
    """JSON has values that TOML has not, and anybody may have written the store."""
    rng, counts = random.Random(7), {True: 0, False: 0}
    records = [parse(text, "f").record() for text in CORPUS]
    for _ in range(RECORDS):
        record = changed(json.loads(rng.choice(records)), rng)
        lines = []
        try:
            plan(validate(record, "mine.zarr"))
        except SweepError as refusal:
            lines = str(refusal).splitlines()
        except Exception as error:
            error.add_note(repr(record))
            raise
        assert all(line.startswith("mine.zarr: ") and line.isprintable() for line in lines)
        counts[not lines] += 1
    assert min(counts.values()) > RECORDS / 50  # both outcomes are tested


HEAD = 'name = "a"\n'
AXES = HEAD + "[axes]\n"
TEN_AXES = "".join(f"{n} = {{ lin = [1, 9], n = 10000000 }}\n" for n in list(QUANTITIES)[4:14])
ENDS = "".join(f"{n} = [5.0, 6.0]\n" for n in COUPLED if n not in ("x0", "xb"))
NASTY = {  # name -> a file, and a part of its refusal; None if it is a sweep
    "cells": (
        AXES + "".join(f"{n} = {{ lin = [1, 9], n = 100000 }}\n" for n in ("K0", "Kenv", "Td")),
        "mine.toml: the sweep must have at most 1,000,000,000,000 scenarios, "
        "but has 1000000000000000.",
    ),
    "ten axes": (AXES + TEN_AXES, "the sweep must have at most 1,000,000,000,000 scenarios"),
    "one axis": (AXES + "K0 = { log = [1, 1000], n = 10000000 }", None),
    "ten billion": (AXES + "K0 = { log = [1, 9], n = 10000000 }\nTd = [1.0, 2.0]", None),
    "through zero": (
        AXES + "Td = { lin = [-1, 1], n = 9999999 }",
        "`axes.Td` must be non-zero and finite, but is 0.",
    ),
    "periods": (
        AXES + "period = { lin = [0.01, 1e5], n = 10000000 }",
        "`axes.period.n` must be at most 1,000,000, but is 10000000.",
    ),
    "a million periods": (
        AXES + "period = { lin = [0.01, 0.02], n = 1000000 }",
        "must be a whole multiple of dt",
    ),
    "infinitely wide": (
        AXES + "gap = { lin = [-1e308, 1e308], n = 9 }",
        "must be between ends whose difference is finite",
    ),
    "too fine": (AXES + "K0 = { lin = [1.0, 1.0000000001], n = 10000000 }", "values that differ"),
    "lhs": (
        HEAD + '[sample]\nn = 10000000\nmethod = "lhs"\n'
        "ranges = { Td = { lin = [1, 2] }, K0 = { lin = [1, 2] } }",
        "`sample.n` must be at most 5,000,000 with lhs, but is 10000000.",
    ),
    "sample": (
        HEAD + "[sample]\nn = 99999999999\nranges = { Td = { lin = [1, 2] } }",
        "`sample.n` must be less than or equal to 4294967296, but is 99999999999.",
    ),
    "seed": (
        HEAD + f"[sample]\nn = 9\nseed = {'9' * 4000}\nranges = {{ Td = {{ lin = [1, 2] }} }}",
        "`sample.seed` must be less than 9223372036854775808, but is 999",
    ),
    "cases": (AXES + ENDS + "[cases]\nTd = [" + "1.0, " * 10000 + "]", None),
    "coupled cases": (
        AXES + ENDS + "[cases]\nx0 = [" + "1.0, " * 10000 + "]\nxb = [" + "2.0, " * 10000 + "]",
        None,
    ),
    "deep array": (AXES + "K0 = " + "[" * 100_000, "not valid TOML: nested too deeply"),
    "deep table": (AXES + "K0 = " + "{ a = " * 100_000, "not valid TOML: nested too deeply"),
    "long key": (HEAD + ".".join(["a"] * 100_000) + " = 1", "a key must have at most 20 parts"),
    "long header": (HEAD + "[" + ".".join(['"a"'] * 100_000) + "]", "at most 20 parts"),
    "inline key": (HEAD + "b = {" + " . ".join(["a"] * 100_000) + " = 1}", "at most 20 parts"),
    "keys": ("".join(f"k{i} = 1\n" for i in range(50_000)), "must have at most 1,000 keys"),
    "tables": ("[[axes]]\na=1\n" * 30_000, "must have at most 1,000 keys"),
    "wrong keys": (HEAD + "".join(f"k{i} = 1\n" for i in range(900)), "and 880 more mistakes"),
    "wrong values": (AXES + "K0 = [" + '"", ' * 90_000 + "]", 'value 1 of `axes.K0` must be a'),
    "many values": (AXES + "K0 = [" + ",".join(f"{i}.5" for i in range(1, 120_000)) + "]", None),
    "metrics": (f"metrics = {['x'] * 5000}\n" + AXES, "`metrics` must be at most 100 values long"),
    "choices": (f"[model]\nlaw = {['x'] * 5000}", "`model.law` must be at most 100 values long"),
    "word": ('name = "' + "a" * 900_000 + '"', "`name` must be letters, digits"),
    "wrong word": (HEAD + "a" * 900_000 + " = 1", "unknown key `aaaa"),
    "choice": (HEAD + '[model]\nlaw = "' + "a" * 900_000 + '"', "`model.law` must be one of algo"),
    "text": ("description = '" + "a" * 900_000 + "'\n" + HEAD, "at most 10,000 letters long, but"),
    "digits": (AXES + "K0 = [" + "9" * 5001 + "]", "not valid TOML: a number of thousands of dig"),
    "hexadecimal": (AXES + "K0 = [0x" + "9" * 90_000 + "]", "value 1 of `axes.K0` must be a nu"),
    "nul": ('name = "a\x00b"', "not valid TOML"),
    "escape": ('name = "a\\u0000b\\u001b[2J\\n"', r'`name` must be letters, digits'),
    "bidi key": (HEAD + '"a\\u202e\\n\\u001b" = 1', r"unknown key `a\u202e\n\x1b`"),
    "names": (HEAD + '[cases]\n"../../x" = [1.0]', "unknown key `cases.../../x`"),
    "metric": ('metrics = ["../../x"]\n' + AXES + "K0 = [1.0]", "unknown metric `../../x`"),
    "name": ('name = "../x"\n[axes]\nK0 = [1.0]', "`name` must be letters, digits"),
    "dates": (AXES + "K0 = [1979-05-27]", '`axes.K0` must be a number, but is "1979-05-27"'),
    "large": ("#" * (MAX_FILE + 1), "must be at most 1,000,000 letters long"),
    "quotes": ("'" * 900_000, "not valid TOML"),
    "words": ("a " * 450_000, "not valid TOML"),
    "dotted text": ("description = '" + "a." * 400 + "'\n" + AXES + "K0 = [1.0]", None),
}  # fmt: skip
CHILD = """
import json, resource
from tests.effort import lines_executed
from tests.spec.test_any_file import NASTY, SweepError, parse, plan

def refusal(text):
    try:
        plan(parse(text, "mine.toml"))
    except SweepError as error:
        return str(error)

virtual = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
memory = virtual + 300_000_000
resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
resource.setrlimit(resource.RLIMIT_CPU, (600, 600))  # s; they take 7: a hang becomes a failure
results = {name: lines_executed(lambda: refusal(text)) for name, (text, _) in NASTY.items()}
print(json.dumps(results))
"""


@pytest.fixture(scope="module")
def nasty():
    """Name -> lines executed and refusal, each in at most 300 MB."""
    ended = subprocess.run(
        [sys.executable, "-c", CHILD],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # else memory grows with the cores
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


@pytest.mark.parametrize("name", NASTY)
def test_a_nasty_file_costs_little_work_and_memory(nasty, name):
    (lines, refusal), (text, wanted) = nasty[name], NASTY[name]
    assert affordable(lines, text)
    if wanted is None:
        assert refusal is None
    else:
        assert wanted in refusal
        assert all(line.startswith("mine.toml: ") for line in refusal.splitlines())
        assert len(refusal) < 10_000


def test_a_device_a_folder_and_a_link_are_refused(tmp_path):
    (tmp_path / "link.toml").symlink_to("/dev/zero")
    (tmp_path / "loop.toml").symlink_to(tmp_path / "loop.toml")
    (tmp_path / "large.toml").touch()
    os.truncate(tmp_path / "large.toml", 2**40)  # a sparse file, which takes no room
    for path, wanted in {
        "/dev/zero": "must be at most 1,000,000 bytes long, but is longer.",
        tmp_path / "link.toml": "must be at most 1,000,000 bytes long, but is longer.",
        tmp_path / "large.toml": "must be at most 1,000,000 bytes long, but is longer.",
        tmp_path / "loop.toml": "can't be read: ",
        tmp_path: "is a folder, no sweep file",
        "/dev/null": "`name` must be given, but is missing.",
        "/no/such": "there is no such file",
        "a\0b": "can't be read: embedded null byte",
        tmp_path / ("x" * 300): "can't be read: ",
    }.items():
        with pytest.raises(SweepError) as refusal:
            load(type(tmp_path)(path))
        assert wanted in str(refusal.value)
        assert len(str(refusal.value).splitlines()) == 1
