"""Stores of every format open today. Regression only: nobody derived what they contain.

All are of PLAN in 32 bits and blocks of 4 cells. Format 1 was stopped after 6 of 12 cells. In the
others block 1 failed with "out of memory", and block 3 was not run. Formats 1 and 2 have metrics of
the definition "samples" and judge nmse alone. A new format adds a store here (`record_golden`);
these stay as they are.
"""

import re
import shlex
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from figures import plot, select
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
from tests.command import typed
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
    3: {"not run": 2, "ok": 4, "diverged": 4, "failed": 2},
}
LARGER = parse(PLAN.replace("5.0, 20.0", "5.0, 20.0, 30.0"), "larger.toml")
FORMATS, OLD = sorted(CELLS), (1, 2)
# Of Kenv = 100, Td = 1 and 5, both cases: what float32 showed in formats 1 and 2, and what
# `record_golden` wrote.
SAMPLES = [0.8621837496757507, 36.22241973876953, 0.8621837496757507, 2.6942298412323]
NMSE = {1: SAMPLES, 2: SAMPLES, 3: [0.125, 0.625, 0.625, 1.125]}
SAMPLED = [0.2035839706659317, 9.321151733398438, 1.017919659614563, 9.074298858642578]
TORQUE = {1: SAMPLED, 2: SAMPLED, 3: [2.0, 2.0, 10.0, 10.0]}
TRUSTED = {  # flags of the same cells, and what `status` says
    1: ({"trusted": [2, 2, 2, 2]}, "nmse 100 %"),
    2: ({"trusted": [2, 2, 2, 2]}, "nmse 50 %"),
    3: (
        {"nmse_trusted": [2, 2, 1, 1], "peak_torque_trusted": [2, 1, 2, 1]},
        "nmse 25 %, peak_torque 25 %",
    ),
}
DEFINITION = {
    1: "means over samples at step ends",
    2: "means over samples at step ends",
    3: "integrals and extremes of the motion",
}


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
    assert Counts.of(store).pending == {1: [2, 3]}.get(form, [1, 3])
    flags, trusted = TRUSTED[form]
    lines = messages.status_lines(store)
    done = {1: "6 of 12 cells (50 %)"}.get(form, "8 of 12 cells (66.67 %)")
    expected = {f"done      {done}", f"trusted   {trusted}", f"metrics   {DEFINITION[form]}"}
    assert expected <= set(lines)
    assert "blocks    2 of 4 to do" in lines

    data = dataset(path)
    assert dict(data.sizes) == {"Kenv": 2, "Td": 3, "case": 2}
    assert data.attrs["metrics_definition_meaning"] == DEFINITION[form]
    first = data.isel(Kenv=0, Td=slice(0, 2))
    assert first["nmse"].values.ravel().tolist() == NMSE[form]
    assert first["peak_torque"].values.ravel().tolist() == TORQUE[form]
    assert {n: first[n].values.ravel().tolist() for n in data if "trusted" in n} == flags
    status = data["status"].values.ravel().tolist()
    known = [1] * 4 + [3] * 2 + [2] * 4 + [0] * 2
    assert status == {1: [1] * 6 + [0] * 6}.get(form, known)
    for name in ("nmse", "peak_torque", "nmse_error", "peak_torque_error"):
        np.testing.assert_array_equal(np.isfinite(data[name]), data["status"] == store_format.OK)
    np.testing.assert_array_equal(data["Denv"], [0.0, 63.2])

    assert plot(data, x="Td", y="Kenv", metric="nmse", at={"case": "0"}).axes
    assert write(data, tmp_path / "golden.csv", "csv") == 12
    table = pd.read_csv(tmp_path / "golden.csv")
    np.testing.assert_allclose(table["nmse"][:4], NMSE[form], rtol=1e-6)
    assert [store_format.STATUS[word] for word in table["status"]] == status
    for name, values in flags.items():
        assert [store_format.TRUSTWORTHY[word] for word in table[name][:4]] == values
    write(data, tmp_path / "golden.nc", "netcdf")
    with xr.open_dataset(tmp_path / "golden.nc") as copy:
        assert copy.attrs["metrics_definition_meaning"] == DEFINITION[form]
        assert set(flags) < set(copy)
    assert contents(path) == before


@pytest.mark.parametrize("form", OLD)
def test_an_old_judgement_is_about_nmse_alone(form):
    data = dataset(GOLDEN / f"format-{form}.zarr")
    for metric in ("nmse", "nmse_error"):
        plane = select(data, x="Td", y="Kenv", metric=metric, at={"case": "0"})
        assert plane.untrusted is not None and not plane.untrusted.any()
        assert plane.trust_bound == "error > 1 % of nmse"
    assert select(data, x="Td", y="Kenv", metric="peak_torque").untrusted is None


@pytest.mark.parametrize("form", OLD)
def test_a_store_of_another_definition_is_run_again_not_continued(form, tmp_path, monkeypatch):
    """The command in the message works when pasted."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(GOLDEN / f"format-{form}.zarr", "my store.zarr")
    before = contents(Path("my store.zarr"))
    (tmp_path / "larger.toml").write_text(PLAN.replace("5.0, 20.0", "5.0, 20.0, 30.0"))
    for more in ((), ("--extend", "larger.toml")):
        refused = typed("resume", "my store.zarr", *more)
        assert refused.code == 2
        (line,) = refused.stderr.splitlines()
        assert f"its metrics are {DEFINITION[1]}, this program's are {DEFINITION[3]}" in line
    assert contents(Path("my store.zarr")) == before
    program, *command = shlex.split(re.search("`(.*)`", line)[1])
    assert program == "fic-sweep"
    assert typed(*command).code == 0
    again = open_store(Path("my store-again.zarr"))
    assert (again.grid.sweep, again.dtype) == (parse(PLAN, "golden.toml"), "float32")
    assert again.definition == "motion"
    exported = typed("export", "my store.zarr", "--to", "csv").stdout
    files = "my store.csv and my store.csv-metadata.json"
    assert exported == f"wrote {files}, 12 scenarios; its metrics are {DEFINITION[1]}\n"
    pictured = typed("plot", "my store.zarr", "--x", "Td", "--y", "Kenv").stdout
    name = "my store-nmse-Td-Kenv-case=1.png"
    assert pictured.startswith(f"wrote {name}; its metrics are {DEFINITION[1]}\n")


def test_the_sweep_of_a_store_is_changed_by_set():
    store = open_store(GOLDEN / "format-2.zarr")
    assert store.sweep_again(("precision=64", "Td=5")).bits == 64
    with pytest.raises(SweepError, match=r"format-2\.zarr: `constants.Td` must be non-zero"):
        store.sweep_again(("Td=0",))


def test_format_1_without_estimates_is_counted(tmp_path):
    path = Path(shutil.copytree(GOLDEN / "format-1.zarr", tmp_path / "golden.zarr"))
    change_attributes(path, error_estimate=0)
    counts = Counts.of(open_store(path))
    assert (counts.cells["ok"], counts.trusted) == (6, {})


def test_format_1_has_no_ledger():
    for refused in (verify, repair_metadata):
        with pytest.raises(SweepError, match="has format 1, ") as refusal:
            refused(GOLDEN / "format-1.zarr")
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("form", OLD)
def test_an_old_format_can_only_be_read(form):
    """Read in its place: a refusal writes nothing."""
    path = GOLDEN / f"format-{form}.zarr"
    before, store = contents(path), open_store(path)
    for refused in (
        lambda: runner.run(store, lambda _: None),
        lambda: extend.extend(store, LARGER, "larger.toml"),
    ):
        with pytest.raises(SweepError, match=f"has format {form}, which can only be read"):
            refused()
    assert contents(path) == before
    assert not [p for p in GOLDEN.iterdir() if p.name.startswith(".")]


def test_a_store_without_a_numerics_version_is_not_resumed(golden):
    """Nobody can tell whether this program would continue it with the same bits."""
    change_attributes(golden, numerics=None)
    reason = "does not record its numerics and arithmetic"
    with pytest.raises(SweepError, match=f"begun by another program .*{reason}") as refused:
        runner.reopen(golden, 32)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("form", [2, 3])
def test_a_format_with_a_ledger_is_verified_and_repaired(form, tmp_path):
    golden = Path(shutil.copytree(GOLDEN / f"format-{form}.zarr", tmp_path / "golden.zarr"))
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


def test_metadata_of_format_2_is_repaired_without_a_copy(tmp_path):
    """The ledger has no copy of a large file: it is made again, in the format of the store."""
    golden = Path(shutil.copytree(GOLDEN / "format-2.zarr", tmp_path / "golden.zarr"))
    before = dataset(golden).load()
    (golden / "trusted" / "zarr.json").unlink()
    with closing(sqlite3.connect(golden / "ledger.sqlite")) as ledger, ledger:
        ledger.execute("UPDATE fixed SET content = NULL WHERE path = 'trusted/zarr.json'")
    (golden / "ledger.sha256").unlink()
    repair_metadata(golden)
    assert verify(golden).problems == ()
    xr.testing.assert_identical(dataset(golden).load(), before)


@pytest.mark.parametrize("larger", [False, True])
def test_format_3_is_continued_and_extended(golden, larger):
    """Below `reopen`, which refuses it: the format allows what the numerics forbid."""
    store = open_store(golden)
    if larger:
        store = extend.extend(store, LARGER, "larger.toml")
    assert runner.run(store, lambda _: None).done == store.grid.cells
    assert verify(golden).problems == ()
    data = dataset(golden).isel(Kenv=0, Td=slice(0, 2))
    assert data["nmse"].values.ravel().tolist() == NMSE[3]
