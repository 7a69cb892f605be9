"""Stores of every format version open today. Regression only: what they hold was never derived.

All are of PLAN in 32 bits and blocks of 4 cells. Format 1 was stopped after 6 of 12 cells. In
format 2 block 1 was made to fail with "out of memory", and block 3 was not run. A new format adds
a store here; these stay as they are.
"""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from figures import plot
from sweeps import runner
from sweeps.cli import messages
from sweeps.export import write
from sweeps.plan.grid import Grid
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import extend
from sweeps.store import opening as store
from sweeps.store.ledger import SET_ASIDE
from sweeps.store.verify import verify

GOLDEN = Path(__file__).parent / "golden"
PLAN = """
name = "golden"
description = "ok, diverged and not run: what a store of each format version must still say"
metrics = ["nmse", "peak_torque"]
error_estimate = true
[time]
t_end = 0.2
[model]
contact = "welded"
[axes]
Kenv = [100.0, 1e9]
Td = [1.0, 5.0, 20.0]
[cases]
Denv = [0.0, 63.2]
gap = [0.0, 0.1]
"""
CELLS = {  # of each status
    1: {"not run": 6, "ok": 6, "diverged": 0, "failed": 0},
    2: {"not run": 2, "ok": 4, "diverged": 4, "failed": 2},
}
FORMATS = sorted(CELLS)
# of Kenv = 100, Td = 1 and 5, both cases: what float32 showed in every format
NMSE = [0.8621837496757507, 36.22241973876953, 0.8621837496757507, 2.6942298412323]
TORQUE = [0.2035839706659317, 9.321151733398438, 1.017919659614563, 9.074298858642578]


@pytest.fixture(params=FORMATS)
def form(request):
    return request.param


@pytest.fixture
def golden(form, tmp_path):
    """A copy, so that what is pinned can't be changed by a look at it."""
    return Path(shutil.copytree(GOLDEN / f"format-{form}.zarr", tmp_path / "golden.zarr"))


def contents(path):
    return {f.relative_to(path): f.read_bytes() for f in path.rglob("*") if f.is_file()}


def test_there_is_one_of_every_format():
    assert list(range(1, store.FORMAT + 1)) == FORMATS
    assert {p.name for p in GOLDEN.iterdir()} == {f"format-{n}.zarr" for n in FORMATS}


def test_it_opens_with_its_plan_and_says_how_far_it_is(golden, form):
    before = contents(golden)
    opened = store.open_store(golden)
    assert opened.grid.sweep == parse(PLAN, "golden.toml")
    assert opened.grid == Grid(parse(PLAN, "golden.toml"), 4)
    tally = store.Tally.of(opened)
    assert tally.cells == CELLS[form]
    assert tally.pending == {1: [2, 3], 2: [1, 3]}[form]
    told = messages.status_lines(opened)
    done = {1: "6 of 12 cells (50 %)", 2: "8 of 12 cells (66.67 %)"}[form]
    assert told[1] == f"done      {done}"
    assert "blocks    2 of 4 to do" in told
    assert [line for line in told if line.startswith("trusted")] == [
        {
            1: "trusted   6 of 6 cells (100 %), nmse known to 1 %",
            2: "trusted   4 of 8 cells (50 %), nmse known to 1 %",
        }[form]
    ]
    assert contents(golden) == before


def test_its_numbers_are_those_of_its_day(golden, form):
    data = store.dataset(golden)
    assert dict(data.sizes) == {"Kenv": 2, "Td": 3, "case": 2}
    first = data.isel(Kenv=0, Td=slice(0, 2))
    assert first["nmse"].values.ravel().tolist() == NMSE
    assert first["peak_torque"].values.ravel().tolist() == TORQUE
    assert (first["trusted"] == store.TRUSTED).all()
    status = data["status"].values.ravel().tolist()
    assert status == {1: [1] * 6 + [0] * 6, 2: [1] * 4 + [3] * 2 + [2] * 4 + [0] * 2}[form]
    for name in ("nmse", "peak_torque", "nmse_error", "peak_torque_error"):
        np.testing.assert_array_equal(np.isfinite(data[name]), data["status"] == store.OK)
    np.testing.assert_array_equal(data["Denv"], [0.0, 63.2])


def test_it_can_be_drawn_and_exported(golden, tmp_path):
    data = store.dataset(golden)
    figure = plot(data, x="Td", y="Kenv", metric="nmse", at={"case": "0"})
    assert figure.axes
    assert write(data, tmp_path / "golden.csv", "csv") == 12
    table = pd.read_csv(tmp_path / "golden.csv")
    np.testing.assert_allclose(table["nmse"][:4], NMSE, rtol=1e-6)
    assert table["status"].tolist() == [
        next(word for word, flag in store.STATUS.items() if flag == value)
        for value in data["status"].values.ravel()
    ]


def test_what_needs_a_ledger_is_refused_in_one_line():
    """Read where it lies: a refusal writes nothing."""
    path = GOLDEN / "format-1.zarr"
    before, opened = contents(path), store.open_store(path)
    larger = parse(PLAN.replace("5.0, 20.0", "5.0, 20.0, 30.0"), "larger.toml")
    for asked in (
        lambda: runner.run(opened, lambda _: None),
        lambda: verify(path),
        lambda: extend.extend(opened, larger, "larger.toml"),
    ):
        with pytest.raises(SweepError, match="has format 1, ") as refused:
            asked()
        assert "\n" not in str(refused.value)
    with pytest.raises(SweepError, match="begun by another program") as refused:
        runner.reopen(path, 32)
    assert "\n" not in str(refused.value)
    assert contents(path) == before
    assert not [p for p in GOLDEN.iterdir() if p.name.startswith(".")]


def test_format_2_is_verified(tmp_path):
    path = Path(shutil.copytree(GOLDEN / "format-2.zarr", tmp_path / "golden.zarr"))
    assert verify(path).problems == ()
    assert verify(path).blocks == 3
    (aside,) = store.Tally.of(store.open_store(path)).set_aside
    assert (aside.block, aside.outcome, aside.attempt) == (1, SET_ASIDE, 3)
    assert re.search("out of memory", aside.error)
    place = path / "nmse" / "c.0.0.0"
    place.write_bytes(place.read_bytes()[:-1] + b"?")
    (problem,) = verify(path).problems
    assert (problem.what, problem.block) == ("nmse/c.0.0.0", 0)
