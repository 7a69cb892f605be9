"""Stores of every format open today. Regression only: nobody derived what they contain.

All are of PLAN in 32 bits and blocks of 4 cells. Format 1 was stopped after 6 of 12 cells. In
format 2 block 1 failed with "out of memory", and block 3 was not run. A new format adds a store
here; these stay as they are.
"""

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
from sweeps.store import format as store_format
from sweeps.store.ledger import SET_ASIDE
from sweeps.store.opening import Counts, dataset, open_store
from sweeps.store.verify import repair_metadata, verify
from tests.store.conftest import GOLDEN
from tests.store.stores import change_attributes

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
LARGER = parse(PLAN.replace("5.0, 20.0", "5.0, 20.0, 30.0"), "larger.toml")
FORMATS = sorted(CELLS)
# of Kenv = 100, Td = 1 and 5, both cases: what float32 showed in every format
NMSE = [0.8621837496757507, 36.22241973876953, 0.8621837496757507, 2.6942298412323]
TORQUE = [0.2035839706659317, 9.321151733398438, 1.017919659614563, 9.074298858642578]


def contents(path):
    return {f.relative_to(path): f.read_bytes() for f in path.rglob("*") if f.is_file()}


def test_every_format_has_a_store():
    assert list(range(1, store_format.FORMAT + 1)) == FORMATS
    assert {p.name for p in GOLDEN.iterdir()} == {f"format-{n}.zarr" for n in FORMATS}


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_is_read_counted_drawn_and_exported(form, tmp_path):
    path = GOLDEN / f"format-{form}.zarr"
    before, store = contents(path), open_store(path)
    assert store.grid == Grid(parse(PLAN, "golden.toml"), 4)
    assert Counts.of(store).cells == CELLS[form]
    assert Counts.of(store).pending == {1: [2, 3], 2: [1, 3]}[form]
    lines = messages.status_lines(store)
    done = {1: "6 of 12 cells (50 %)", 2: "8 of 12 cells (66.67 %)"}[form]
    trusted = {1: "6 of 6 cells (100 %)", 2: "4 of 8 cells (50 %)"}[form]
    assert {f"done      {done}", f"trusted   {trusted}, nmse known to 1 %"} <= set(lines)
    assert "blocks    2 of 4 to do" in lines

    data = dataset(path)
    assert dict(data.sizes) == {"Kenv": 2, "Td": 3, "case": 2}
    first = data.isel(Kenv=0, Td=slice(0, 2))
    assert first["nmse"].values.ravel().tolist() == NMSE
    assert first["peak_torque"].values.ravel().tolist() == TORQUE
    assert (first["trusted"] == store_format.TRUSTED).all()
    status = data["status"].values.ravel().tolist()
    assert status == {1: [1] * 6 + [0] * 6, 2: [1] * 4 + [3] * 2 + [2] * 4 + [0] * 2}[form]
    for name in ("nmse", "peak_torque", "nmse_error", "peak_torque_error"):
        np.testing.assert_array_equal(np.isfinite(data[name]), data["status"] == store_format.OK)
    np.testing.assert_array_equal(data["Denv"], [0.0, 63.2])

    assert plot(data, x="Td", y="Kenv", metric="nmse", at={"case": "0"}).axes
    assert write(data, tmp_path / "golden.csv", "csv") == 12
    table = pd.read_csv(tmp_path / "golden.csv")
    np.testing.assert_allclose(table["nmse"][:4], NMSE, rtol=1e-6)
    assert [store_format.STATUS[word] for word in table["status"]] == status
    assert contents(path) == before


def test_format_1_without_estimates_is_counted(tmp_path):
    path = Path(shutil.copytree(GOLDEN / "format-1.zarr", tmp_path / "golden.zarr"))
    change_attributes(path, error_estimate=0)
    counts = Counts.of(open_store(path))
    assert (counts.cells["ok"], counts.trusted) == (6, 0)


def test_format_1_can_only_be_read():
    """Read in its place: a refusal writes nothing."""
    path = GOLDEN / "format-1.zarr"
    before, store = contents(path), open_store(path)
    for refused in (
        lambda: runner.run(store, lambda _: None),
        lambda: verify(path),
        lambda: repair_metadata(path),
        lambda: extend.extend(store, LARGER, "larger.toml"),
    ):
        with pytest.raises(SweepError, match="has format 1, ") as refusal:
            refused()
        assert "\n" not in str(refusal.value)
    assert contents(path) == before
    assert not [p for p in GOLDEN.iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize("form", FORMATS)
def test_a_store_without_a_numerics_version_is_not_resumed(form):
    """Nobody can tell whether this program would continue it with the same bits."""
    reason = "does not record its numerics and arithmetic"
    with pytest.raises(SweepError, match=f"begun by another program .*{reason}") as refused:
        runner.reopen(GOLDEN / f"format-{form}.zarr", 32)
    assert "\n" not in str(refused.value)


def test_format_2_is_verified_and_repaired(golden):
    before = contents(golden)
    assert verify(golden).problems == ()
    assert verify(golden).blocks == 3
    (aside,) = Counts.of(open_store(golden)).set_aside
    assert (aside.block, aside.outcome, aside.attempt) == (1, SET_ASIDE, 3)
    assert "out of memory" in aside.error
    for name in ("zarr.json", "Td/c.0", "nmse/zarr.json"):  # as the program of its day wrote them
        (golden / name).unlink()
    repair_metadata(golden)
    assert contents(golden) == before
    place = golden / "nmse" / "c.0.0.0"
    place.write_bytes(place.read_bytes()[:-1] + b"?")
    (problem,) = verify(golden).problems
    assert (problem.what, problem.block) == ("nmse/c.0.0.0", 0)


@pytest.mark.parametrize("larger", [False, True])
def test_format_2_is_continued_and_extended(golden, larger):
    """Below `reopen`, which refuses it: the format allows what the numerics forbid."""
    store = open_store(golden)
    if larger:
        store = extend.extend(store, LARGER, "larger.toml")
    assert runner.run(store, lambda _: None).done == store.grid.cells
    assert verify(golden).problems == ()
    data = dataset(golden).isel(Kenv=0, Td=slice(0, 2))
    assert data["nmse"].values.ravel().tolist() == NMSE
