"""`[refine]` on the command line, and what one can get wrong about it."""

import itertools
import re

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from sweeps.cli import interruption
from sweeps.store.commit import Writer
from sweeps.store.opening import Counts, open_store
from tests.command import typed

BEGIN = """
name = "border"
[time]
t_end = 1.0
[axes]
K0 = { log = [10.0, 150.0], n = 5 }
Td = { lin = [1.0, 9.0], n = 5 }
gap = [0.0, 0.1]
"""
TABLE = '[refine]\nlevels = 2\nclasses = ["nmse < 0.3"]\n'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "border.toml").write_text(BEGIN + TABLE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ran")
    (folder / "border.toml").write_text(BEGIN + TABLE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        ended = typed("run", "border.toml")
    assert (ended.code, ended.stderr) == (0, "")
    return folder, ended.stdout


def test_a_dry_run_names_both_grids_and_the_most_scenarios(folder):
    printed = typed("run", "border.toml", "--dry-run").stdout
    assert "K0 17 x Td 17 x gap 2 = 578 cells of 100 steps\n" in printed
    begin = "refined from K0 5 x Td 5 x gap 2 = 50 scenarios: K0, Td halved up to 2 times\n"
    assert begin in printed
    assert "at most 578 scenarios (all cells; `refine.budget` allows fewer)\n" in printed
    assert re.search("^at most .* measured just now$", printed, re.MULTILINE)
    few = typed("run", "border.toml", "--dry-run", "--set", "budget=100", "--set", "axes=['K0']")
    assert "K0 17 x Td 5 x gap 2 = 170 cells" in few.stdout
    assert "at most 100 scenarios (the budget)\n" in few.stdout
    assert not list(folder.glob("*.zarr"))


def test_each_command_says_what_was_simulated(ran, monkeypatch):
    folder, printed = ran
    monkeypatch.chdir(folder)
    status = np.nan_to_num(xr.open_zarr("border.zarr").status.values)
    n = int((status == 1).sum())
    assert 50 < n < 500
    assert f"border.zarr: {n} scenarios in " in printed
    assert f"refined   {n} of 578 cells simulated" in printed
    assert f"{578 - n} have the values of a simulated cell beside them" in printed
    said = typed("status", "border.zarr").stdout
    assert f"simulated {n} of 578 cells" in said
    assert re.search(rf"nearby +{578 - n}\n", said) and re.search(r"not run +0\n", said)
    assert f"complete already, {n} scenarios" in typed("resume", "border.zarr").stdout
    assert "all as written" in typed("verify", "border.zarr").stdout
    exported = typed("export", "border.zarr", "--to", "csv").stdout
    assert f"border.csv-metadata.json, 578 cells, {n} of them simulated" in exported
    table = pd.read_csv("border.csv")
    assert table["status"].value_counts().to_dict() == {"ok": n, "ok_nearby": 578 - n}
    assert set(table["level"]) == {0, 1, 2}
    for to in ("parquet", "netcdf"):
        assert typed("export", "border.zarr", "--to", to).code == 0
    with xr.open_dataset("border.nc") as copy:
        np.testing.assert_array_equal(copy.level, xr.open_zarr("border.zarr").level)
    for metric in ("nmse", "level"):
        plotted = typed("plot", "border.zarr", "--x", "K0", "--y", "Td", "--metric", metric)
        assert plotted.code == 0, plotted.stderr
    assert typed("run", "border.zarr", "--dry-run", "--out", "b.zarr").code == 0


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("levels = 2\naxes = ['Denv']", "`refine.axes` must name axes, but has `Denv`"),
        ("levels = 2\naxes = ['gap']", "`refine.axes` must name ranges .* `gap` is a list"),
        ("levels = 2\naxes = ['K0', 'K0']", "`refine.axes` must be different from each other"),
        ("levels = 2\naxes = []", "`refine.axes` must be at least 1 values long|not empty"),
        ("levels = 2\nabsolute = { speed = 1.0 }", "name metrics of the sweep, but has `speed`"),
        ("levels = 2\nabsolute = { nmse = -1.0 }", "`refine.absolute.nmse` must be greater than 0"),
        ("levels = 2\nrelative = { nmse = 0 }", "`refine.relative.nmse` must be greater than 0"),
        ("levels = 2\nrelative = { nmse = nan }", "`refine.relative.nmse` must be a finite number"),
        (
            "levels = 2\nrelative = { nmse = 1 }\nabsolute = { nmse = 1 }",
            "one tolerance of `nmse`, but has two",
        ),
        ("levels = 2\nclasses = ['K0 < 3']", "names of metrics alone, but has `K0`"),
        ("levels = 2\nclasses = ['nmse <']", "`refine.classes` must be a condition"),
        ("levels = 2\nclasses = ['1 < inf']", "`refine.classes` must name a metric"),
        ("levels = 2\nclasses = []", "must name classes or a metric"),
        ("levels = 2\nbudget = 49", "`refine.budget` must be at least 50, .* is 49"),
        ("levels = 0", "`refine.levels` must be greater than or equal to 1"),
        ("levels = 20", "`refine.levels` must make at most 100,000,000 cells"),
        ("levels = 10", "`refine.budget` must be at most 20,000,000, but none is given"),
        ("levels = 1.5", "`refine.levels` must be a"),
        ("levls = 2", "`refine.levels` must be given|did you mean `levels`"),
        ("levels = 2\n[reduce]\nover = ['gap']\nmax = ['nmse']", "must be without `reduce`"),
    ],
)
def test_a_wrong_table_is_one_line(folder, table, words):
    (folder / "border.toml").write_text(f"{BEGIN}[refine]\n{table}\n")
    ended = typed("run", "border.toml")
    assert ended.code == 2 and not ended.stdout
    assert re.search(words, ended.stderr), ended.stderr
    assert all(line.startswith("fic-sweep: border.toml: ") for line in ended.stderr.splitlines())
    assert not list(folder.glob("*.zarr"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run", "border.toml", "--shard", "1/2"), "which no shard knows of the others"),
        (
            ("run", "border.toml", "--dask", "local:2"),
            "each round needs the values of all cells; run it without a cluster",
        ),
        (("run", "drawn.toml"), "`refine` must be without `sample`, but both are given."),
        (("run", "few.toml"), "has `convergence_time` .the default.; `metrics` lacks it"),
        (("run", "even.toml"), "`axes.period` must be a whole multiple of dt"),
    ],
)
def test_what_does_not_go_together_is_refused(folder, arguments, words):
    refine = "[refine]\nlevels = 2\n"
    sample = "[sample]\nn = 8\nranges = { K0 = { log = [1.0, 9.0] } }\n"
    (folder / "drawn.toml").write_text(f'name = "drawn"\n{sample}{refine}')
    (folder / "few.toml").write_text('metrics = ["nmse"]\n' + BEGIN + refine)
    period = "period = { lin = [0.01, 0.05], n = 5 }\n"
    (folder / "even.toml").write_text(f'name = "even"\n[axes]\n{period}{refine}')
    ended = typed(*arguments)
    assert ended.code == 2 and re.search(words, ended.stderr), ended.stderr
    assert not list(folder.glob("*.zarr"))


def test_a_budget_that_ended_a_run_is_named_and_can_be_raised(folder):
    said = (
        "budget    62 scenarios ended the run: from level 0 of 2 on, boxes that differ are not "
        "halved\n          `fic-sweep resume border.zarr --budget 124` goes on\n"
    )
    for command in (
        ("run", "border.toml", "--set", "budget=62"),
        ("status", "border.zarr"),
        ("resume", "border.zarr"),
    ):
        assert said in typed(*command).stdout
    assert Counts.of(open_store(folder / "border.zarr")).done < 62  # not hit exactly
    more = typed("resume", "border.zarr", "--budget", "120").stdout
    assert "ended the run: from level 1 of 2 on" in more and "--budget 240`" in more
    (folder / "more.toml").write_text(f"{BEGIN}{TABLE}budget = 500\n")
    last = typed("resume", "border.zarr", "--extend", "more.toml").stdout
    assert "of 578 cells simulated" in last and "budget" not in last
    assert "budget    " not in typed("status", "border.zarr").stdout
    (folder / "plain.toml").write_text(BEGIN.replace("border", "plain"))
    assert typed("run", "plain.toml").code == 0
    for arguments, words in (
        (("border.zarr", "--budget", "500"), "must be more than the store's 500, but is 500"),
        (("border.zarr", "--budget", "9"), "must be at least 50, the scenarios of the coarse"),
        (("border.zarr", "--budget", "501"), "nothing is left to halve"),
        (("border.zarr", "--budget", "0"), "must be greater than or equal to 1"),
        (("border.zarr", "--budget", "9", "--extend", "more.toml"), "--budget: one of them"),
        (("plain.zarr", "--budget", "9"), "--budget 9: plain.zarr is not refined"),
    ):
        ended = typed("resume", *arguments)
        assert ended.code == 2 and words in ended.stderr, ended.stderr
        assert len(ended.stderr.splitlines()) == 1


def test_a_refined_store_is_neither_reduced_nor_extended(ran, monkeypatch):
    monkeypatch.chdir(ran[0])
    reduced = typed("reduce", "border.zarr", "--over", "K0", "--max", "nmse")
    assert reduced.code == 2 and "most of its cells were not simulated" in reduced.stderr
    (ran[0] / "plain.toml").write_text(BEGIN)
    other = TABLE.replace("levels = 2", "levels = 3")
    kept, enough = "`refine` must be as in the store", "the store may simulate all its "
    for table, why in (("", kept), (TABLE, enough), (other, kept)):
        (ran[0] / "more.toml").write_text(BEGIN + table)
        more = typed("resume", "border.zarr", "--extend", "more.toml")
        assert more.code == 2 and more.stderr.startswith(f"fic-sweep: more.toml: {why}")
    assert typed("resume", "border.zarr", "--dask", "local:2").code == 2


def interrupted_at(monkeypatch, number):
    """Request a stop as the run writes its block of this number; 0: before it writes one."""
    calls, commit = itertools.count(), Writer.commit

    def stopped(writer, values, row):
        if number == 0:
            raise KeyboardInterrupt
        row = commit(writer, values, row)
        if next(calls) + 1 == number:
            stop.requested = True
        return row

    stop = interruption.Stop()
    monkeypatch.setattr(interruption, "Stop", lambda: stop)
    monkeypatch.setattr(Writer, "commit", stopped)


def test_a_run_that_only_writes_blocks_says_so(folder, monkeypatch):
    with monkeypatch.context() as patch:
        interrupted_at(patch, 0)
        ended = typed("run", "border.toml", "--chunk", "200")
    assert ended.code == 1 and "`fic-sweep resume border.zarr` does the rest" in ended.stderr
    n = Counts.of(open_store(folder / "border.zarr")).done
    with monkeypatch.context() as patch:
        interrupted_at(patch, 2)
        assert typed("resume", "border.zarr").code == 1
    said = typed("resume", "border.zarr").stdout
    assert f"border.zarr: {n} scenarios simulated before, 2 blocks written in " in said
    assert f"refined   {n} of 578 cells simulated" in said
    assert f"complete already, {n} scenarios" in typed("resume", "border.zarr").stdout


def test_a_stop_at_the_last_block_comes_too_late(folder, monkeypatch):
    interrupted_at(monkeypatch, 4)
    ended = typed("run", "border.toml", "--chunk", "200")
    assert ended.code == 0 and re.match(r"border.zarr: \d+ scenarios in ", ended.stdout)
