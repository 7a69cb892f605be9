"""Refined stores: the plain grid's bits and border, however the run was interrupted."""

import itertools
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from figures import choose, draw
from sweeps import runner
from sweeps.cli.messages import verification
from sweeps.plan.grid import Grid
from sweeps.plan.shard import Shard
from sweeps.refine import rounds
from sweeps.refine.budget import with_budget
from sweeps.refine.rounds import WAIT
from sweeps.spec.mistakes import SweepError, command
from sweeps.spec.reading import parse
from sweeps.store.commit import Writer
from sweeps.store.extend import extend
from sweeps.store.format import DIVERGED, FAILED, NEAR, NOT_RUN, OK
from sweeps.store.journal import MOST_MISSING, Journal
from sweeps.store.ledger import DONE, SET_ASIDE
from sweeps.store.opening import Counts, dataset, open_store
from sweeps.store.verify import verify
from tests.refine.test_boxes import edge
from tests.store.stores import contents, flip, repaired
from tests.test_runner import bits, complete, quiet

TEXT = """
name = "border"
[time]
t_end = 10.0
[model]
contact = "hard_stop"
[axes]
sigma = { log = [0.0001, 1.0], n = 17 }
Kenv = { log = [10.0, 1000.0], n = 17 }
"""
REFINED = TEXT + "[refine]\nlevels = 3\n"
FINEST = TEXT.replace("n = 17", "n = 129")
# Two contacts, two cases and a list beside the refined axis; cells at Kenv = 1e9 diverge.
SMALL = """
name = "small"
metrics = ["nmse", "convergence_time", "mode_switches"]
error_estimate = true
[time]
t_end = 0.5
[model]
contact = ["welded", "hard_stop"]
[axes]
K0 = { log = [1.0, 300.0], n = 4 }
Kenv = [100.0, 1e9]
[cases]
Denv = [0.0, 63.2]
[refine]
levels = 3
classes = ["nmse < 0.3"]
relative = { mode_switches = 0.5 }
"""
PLAN = parse(SMALL, "small.toml")
QUICK = parse(
    """
name = "quick"
metrics = ["nmse", "peak_torque"]
[time]
t_end = 0.5
[axes]
K0 = { log = [1.0, 300.0], n = 5 }
Kenv = { log = [10.0, 1e9], n = 3 }
[refine]
levels = 3
classes = ["nmse < 0.3"]
""",
    "quick.toml",
)


@pytest.fixture(scope="module")
def border(memory):
    return complete(memory / "border.zarr", parse(REFINED, "refined")).path


@pytest.fixture(scope="module")
def full(memory):
    return complete(memory / "full.zarr", parse(FINEST, "full")).path


@pytest.fixture(scope="module")
def small(memory):
    return complete(memory / "small.zarr", PLAN, chunk=13).path


@pytest.fixture
def each_batch(monkeypatch):
    """Write after each batch, as a run of hours does."""
    monkeypatch.setattr(rounds, "WAIT", 0.0)
    monkeypatch.setattr(rounds, "SHARE", 0.0)


@pytest.fixture(scope="module")
def quick(memory):
    return complete(memory / "quick.zarr", QUICK, chunk=60).path


def words(path):
    """Status of each cell as a whole number, and which cells were simulated."""
    status = np.nan_to_num(xr.open_zarr(path).status.values).astype(int)
    return status, np.isin(status, (OK, DIVERGED))


def classes(path):
    data = xr.open_zarr(path)
    return np.isfinite(data.convergence_time.values) + 2 * (data.contact_lost.values == 0)


# --- against the plain grid ----------------------------------------------------------------------


def test_a_simulated_cell_has_the_bits_of_the_plain_grid(border, full):
    _, simulated = words(border)
    refined, plain = xr.open_zarr(border), xr.open_zarr(full)
    for name in plain.data_vars:
        if name != "status":
            here, there = refined[name].values[simulated], plain[name].values[simulated]
            assert here.tobytes() == there.tobytes(), name
    for name in ("sigma", "Kenv"):
        np.testing.assert_array_equal(refined[name], plain[name])
    assert 0.02 < simulated.mean() < 0.2


def test_the_border_is_the_plain_grids(border, full):
    """Each cell of the plain grid at which the class changes was simulated."""
    _, simulated = words(border)
    assert simulated[edge(classes(full))].all()
    np.testing.assert_array_equal(classes(border), classes(full))


def test_the_axes_have_the_values_of_the_coarse_grid_and_short_decimals(border):
    data, coarse = xr.open_zarr(border), parse(TEXT, "coarse")
    for name in ("sigma", "Kenv"):
        np.testing.assert_array_equal(data[name][::8], coarse.axis_values(name))
    assert 0.01 in data.sigma.values and 100.0 in data.Kenv.values
    plan = parse('name = "a"\n[axes]\nTd = { lin = [1.0, 2.0], n = 6 }\n[refine]\nlevels = 1', "a")
    assert plan.axis_values("Td").tolist() == [round(1 + i / 10, 1) for i in range(11)]


def test_a_cell_that_was_not_simulated_says_so_and_has_a_corners_values(border):
    status, simulated = words(border)
    assert set(np.unique(status)) == {OK, NEAR["ok nearby"]}
    data = xr.open_zarr(border).load()
    level = data.level.values
    assert (level[simulated].min(), level.max()) == (0, 3)
    for row, column in np.argwhere(~simulated)[::97]:
        half = int(8 / 2 ** level[row, column]) // 2
        around = data.isel(
            sigma=slice(max(row - half, 0), row + half + 1),
            Kenv=slice(max(column - half, 0), column + half + 1),
        )
        own = data.isel(sigma=row, Kenv=column)
        there = around.where(around.status == OK)
        assert (there.nmse == own.nmse).any() and (there.peak_torque == own.peak_torque).any()


def test_dimensions_that_are_not_ranges_and_estimates(small, memory):
    """Each contact, case and list value is refined by itself; errors and trust go along."""
    plain = SMALL.partition("[refine]")[0].replace("n = 4", "n = 25")
    full = xr.open_zarr(complete(memory / "plain.zarr", parse(plain, "plain")).path)
    data, (status, simulated) = xr.open_zarr(small), words(small)
    assert dict(data.sizes) == {"contact": 2, "K0": 25, "Kenv": 2, "case": 2}
    for name in set(full.data_vars) - {"status"}:
        here, there = data[name].values[simulated], full[name].values[simulated]
        assert here.tobytes() == there.tobytes(), name
    diverged = np.isnan(data.nmse.values)
    np.testing.assert_array_equal(diverged & simulated, status == DIVERGED)
    np.testing.assert_array_equal(diverged & ~simulated, status == NEAR["diverged nearby"])
    assert (status == NEAR["diverged nearby"]).any()
    per_slice = simulated.sum(axis=1)
    assert per_slice.min() == 4 and per_slice.max() > 6  # all diverged; a border and its vicinity
    counts = Counts.of(open_store(small))
    assert counts.done == simulated.sum()
    assert counts.cells["nearby"] == (~simulated).sum() and counts.cells["not run"] == 0
    trusted = np.nan_to_num(data.nmse_trusted.values)
    assert counts.trusted["nmse"] == ((trusted == 2) & (status == OK)).sum()
    assert not counts.pending and not verify(small).problems


def test_double_precision(memory):
    plan = parse(SMALL, "small.toml")
    data = xr.open_zarr(complete(memory / "double.zarr", plan, precision=64).path)
    assert data.nmse.dtype == np.float64 and (data.status == OK).any()


def test_neither_blocks_nor_batches_change_a_bit(small, memory):
    assert bits(complete(memory / "one.zarr", PLAN).path) == bits(small)


# --- interrupted ---------------------------------------------------------------------------------


class Killed(BaseException):
    """Nothing that the program catches."""


def killed_at(monkeypatch, number):
    """Kill the run at its simulation of this number."""
    simulated, calls = runner._simulated, itertools.count(1)

    def simulate(*arguments):
        if next(calls) == number:
            raise Killed
        return simulated(*arguments)

    monkeypatch.setattr(runner, "_simulated", simulate)


def test_killed_at_every_simulation_and_resumed(tmp_path, quick, each_batch, monkeypatch):
    for number in itertools.count(1):
        path = tmp_path / f"{number}.zarr"
        store = runner.start(path, QUICK, 60, 32)
        with monkeypatch.context() as patch:
            killed_at(patch, number)
            try:
                runner.run(store, quiet)
                break
            except Killed:
                pass
        runner.run(open_store(path), quiet)
        assert contents(path) == contents(quick)
    assert number > 5


def test_killed_again_and_again(tmp_path, quick, each_batch, monkeypatch):
    path = tmp_path / "a.zarr"
    store = runner.start(path, QUICK, 60, 32)
    for _ in range(100):
        with monkeypatch.context() as patch:
            killed_at(patch, 2)
            try:
                runner.run(open_store(path), quiet)
                break
            except Killed:
                assert not verify(path).problems
    assert contents(path) == contents(quick)
    assert {row.outcome for row in store.rows()} == {DONE}


def test_a_stop_keeps_all_that_was_simulated(tmp_path, quick):
    path, seen = tmp_path / "a.zarr", []

    def stop(progress):
        seen.append(progress)
        if progress.done >= 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runner.run(runner.start(path, QUICK, 60, 32), stop)
    assert WAIT > 1  # nothing was written before the stop
    assert Counts.of(open_store(path)).done == seen[-1].done >= 40
    assert not open_store(path).rows() and not verify(path).problems
    again = runner.run(open_store(path), quiet)
    assert again.ran == again.done - seen[-1].done
    assert again.cells == again.done == Counts.of(open_store(path)).done
    assert contents(path) == contents(quick)
    assert runner.run(open_store(path), quiet).ran == 0


def test_a_process_that_is_killed(tmp_path, border):
    """A real SIGKILL of a real process, at some block; then the rest."""
    path = tmp_path / "border.zarr"
    runner.start(path, parse(REFINED, "refined"), 2000, 32)
    code = """
import os, signal, sys
from pathlib import Path
from sweeps import runner
from sweeps.refine import rounds
from sweeps.store.opening import open_store
rounds.WAIT = rounds.SHARE = 0.0
runner.configure(32)
def kill(progress):
    if progress.done > 900:
        os.kill(os.getpid(), signal.SIGKILL)
runner.run(open_store(Path(sys.argv[1])), kill)
"""
    ended = subprocess.run([sys.executable, "-c", code, str(path)], timeout=120, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert 0 < Counts.of(open_store(path)).done < 2000
    runner.run(open_store(path), quiet)
    assert bits(path) == bits(border)


def test_what_is_damaged_is_simulated_again(tmp_path, quick):
    path = tmp_path / "quick.zarr"
    complete(path, QUICK, chunk=60)
    expected = contents(path)
    first, *_, last = sorted((path / "nmse").glob("c.*"))
    first.write_bytes(b"nonsense")
    (path / "status" / last.name).unlink()
    assert len(repaired(path).bad_blocks) == 2
    assert contents(path) == expected == contents(quick)
    assert not verify(path).problems


def test_cells_that_fail_are_set_aside_and_the_rest_stays(tmp_path, quick, monkeypatch):
    path, calls, simulated = tmp_path / "a.zarr", itertools.count(), runner._simulated

    def fail(*arguments):
        if next(calls) > 2:
            raise MemoryError("no room\non the device")
        return simulated(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(runner, "_simulated", fail)
        result = runner.run(runner.start(path, QUICK, 60, 32), quiet)
    store = open_store(path)
    assert {row.error for row in result.set_aside} == {"MemoryError: no room"}
    counts = Counts.of(store)
    assert counts.cells["failed"] > 0 and counts.done == result.done > 0
    assert {row.block for row in counts.set_aside} == {row.block for row in result.set_aside}
    assert {row.outcome for row in counts.set_aside} == {SET_ASIDE}
    status, _ = words(path)
    assert set(np.unique(status)) == {NOT_RUN, FAILED}  # the others wait in the journal
    assert "end" not in store.group.attrs
    runner.run(store, quiet)
    assert contents(path) == contents(quick)


def test_a_damaged_journal_is_named_and_its_cells_are_simulated_again(
    tmp_path, quick, each_batch, monkeypatch
):
    path = tmp_path / "a.zarr"
    with monkeypatch.context() as patch:
        killed_at(patch, 5)
        with pytest.raises(Killed):
            runner.run(runner.start(path, QUICK, 60, 32), quiet)
    store = open_store(path)
    files = store.journal.files()
    assert [file.name for file in files] == [f"simulated.{i}" for i in range(1, 5)]
    before = Counts.of(store).done
    flip(files[1], 5000)
    files[2].write_bytes(b"")
    shutil.copy(files[0], path / "simulated.7")  # the same cells twice
    report = verify(path)
    (problem, other) = report.problems
    assert (problem.what, other.what) == ("simulated.2", "simulated.3")
    assert "a run simulates its cells again" in problem.how
    *_, advice = verification(path, report)
    assert advice == f"  {report.planned} blocks still to run: {command('resume', path)} does"
    assert 0 < Counts.of(store).done < before + 25
    runner.run(open_store(path), quiet)
    assert contents(path) == contents(quick)


def test_a_flipped_bit_in_the_count_of_a_journal_makes_no_endless_list(tmp_path):
    store = runner.start(tmp_path / "a.zarr", QUICK, 60, 32)
    store.ledger.count_files(2**30)
    assert len(store.journal.missing()) == MOST_MISSING


@pytest.mark.parametrize("deleted", [(1,), (2, 4), (4,), (1, 2, 3, 4)])
def test_a_deleted_file_of_the_journal_is_missed(tmp_path, quick, each_batch, monkeypatch, deleted):
    path = tmp_path / "a.zarr"
    with monkeypatch.context() as patch:
        killed_at(patch, 5)
        with pytest.raises(Killed):
            runner.run(runner.start(path, QUICK, 60, 32), quiet)
    assert not verify(path).problems
    for number in deleted:
        (path / f"simulated.{number}").unlink()
    names = [f"simulated.{number}" for number in deleted]
    assert [problem.what for problem in verify(path).problems] == names
    assert verify(path).problems[0].how == "is missing; a run simulates its cells again"
    with monkeypatch.context() as patch:
        killed_at(patch, 2)
        with pytest.raises(Killed):
            runner.run(open_store(path), quiet)
    left = [problem.what for problem in verify(path).problems]
    assert left == names[1:]  # the first one has been written again
    runner.run(open_store(path), quiet)
    assert contents(path) == contents(quick) and not verify(path).problems


def test_a_journal_of_another_sweep_is_not_read(tmp_path, each_batch, monkeypatch):
    names = ("a.zarr", "b.zarr")
    for name, plan in zip(names, (QUICK, QUICK.model_copy(update={"name": "other"})), strict=True):
        with monkeypatch.context() as patch:
            killed_at(patch, 2)
            with pytest.raises(Killed):
                runner.run(runner.start(tmp_path / name, plan, 60, 32), quiet)
    shutil.copy(tmp_path / "a.zarr/simulated.1", tmp_path / "b.zarr/simulated.1")
    assert not list(open_store(tmp_path / "b.zarr").journal.read())
    assert len(open_store(tmp_path / "b.zarr").journal.damaged()) == 1


def test_a_kill_before_the_last_lines_of_a_run(tmp_path, quick, each_batch, monkeypatch):
    """All blocks are done, but the journal is there, and the time of the end is missing."""
    path = tmp_path / "a.zarr"
    with monkeypatch.context() as patch:

        def killed(_):
            raise Killed

        patch.setattr(Journal, "clear", killed)
        with pytest.raises(Killed):
            runner.run(runner.start(path, QUICK, 60, 32), quiet)
    store = open_store(path)
    assert store.journal.files() and not Counts.of(store).pending and not verify(path).problems
    assert "end" not in store.group.attrs
    assert runner.run(store, quiet).ran == 0
    assert contents(path) == contents(quick)
    assert "end" in open_store(path).group.attrs


# --- sizes ---------------------------------------------------------------------------------------


def test_a_budget_ends_the_run(memory, full):
    """The coarsest boxes come first: the border is equally fine all along."""
    plan = parse(REFINED + "budget = 700\n", "refined")
    path = complete(memory / "budget.zarr", plan).path
    _, simulated = words(path)
    assert simulated.sum() <= 700 < simulated.sum() + 9
    level = xr.open_zarr(path).level.values
    assert set(np.unique(level[edge(classes(full))])) <= {1, 2, 3}
    again = complete(memory / "again.zarr", plan, chunk=1000).path
    assert bits(again) == bits(path)
    assert xr.open_zarr(path).attrs["refined_axes"] == "sigma Kenv"


def with_refine(plan, **changes):
    return plan.model_copy(update={"refine": plan.refine.model_copy(update=changes)})


def ended_at(path):
    return xr.open_zarr(path).attrs.get("budget_ended_at_level")


@pytest.mark.parametrize("simulations", [2, None])
def test_a_larger_budget_goes_on(tmp_path, quick, each_batch, monkeypatch, simulations):
    """Of a run that its budget ended, or that was killed: with the bits of a run that had it."""
    path, few = tmp_path / "a.zarr", with_refine(QUICK, budget=40)
    store = runner.start(path, few, 60, 32)
    with monkeypatch.context() as patch:
        killed_at(patch, simulations)
        if simulations:
            with pytest.raises(Killed):
                runner.run(store, quiet)
        else:
            runner.run(store, quiet)
    before = Counts.of(open_store(path)).done
    assert 0 < before <= 40 and (ended_at(path) is None) == bool(simulations)
    note = path / "note.txt"
    for budget in (60, None):
        note.write_text("mine")
        plan = with_refine(QUICK, budget=budget)
        store = with_budget(open_store(path), plan, "more")
        assert Counts.of(store).done == before and not verify(path).problems
        assert note.read_text() == "mine"
        note.unlink()
        result = runner.run(store, quiet)
        assert before + result.ran == result.done
        fresh = complete(tmp_path / f"{budget}.zarr", plan, chunk=60).path
        assert contents(path) == contents(fresh)
        assert (ended_at(path) is None) == (budget is None)
        before = result.done
    assert contents(path) == contents(quick)


def test_what_is_no_larger_budget(memory, quick):
    store = open_store(quick)
    for plan, line in (
        (QUICK, "the store may simulate all its 561 cells: a larger budget changes nothing."),
        (with_refine(QUICK, levels=2), "`refine` must be as in the store"),
        (QUICK.model_copy(update={"metrics": ["nmse"]}), "`metrics` must be as in the store"),
        (QUICK.model_copy(update={"precision": 64}), "`precision` must be that of the store, 32."),
    ):
        with pytest.raises(SweepError, match=f"more: {re.escape(line)}"):
            with_budget(store, plan, "more")
    enough = with_refine(QUICK, budget=560)
    path = complete(memory / "enough.zarr", enough).path
    with pytest.raises(SweepError, match="nothing is left to halve"):
        with_budget(open_store(path), QUICK, "more")


def test_a_kill_before_the_last_lines_of_a_run_that_its_budget_ended(tmp_path, monkeypatch):
    path, few = tmp_path / "a.zarr", with_refine(QUICK, budget=40)
    with monkeypatch.context() as patch:
        patch.setattr(Writer, "end", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            runner.run(runner.start(path, few, 60, 32), quiet)
    assert ended_at(path) is None
    assert runner.run(open_store(path), quiet).ran == 0
    assert ended_at(path) in (0, 1, 2) and "end" in open_store(path).group.attrs


def test_a_metric_that_changes_fast(memory):
    plan = parse(REFINED + "classes = []\nrelative = { nmse = 0.5 }\n", "refined")
    data = xr.open_zarr(complete(memory / "metric.zarr", plan).path)
    _, simulated = words(memory / "metric.zarr")
    level, value = data.level.values, np.log(data.nmse.values)
    assert 0.01 < simulated.mean() < 0.9 and level.max() == 3
    coarse = value[::8, ::8]
    corners = np.stack([coarse[i : i + 16, j : j + 16] for i in (0, 1) for j in (0, 1)])
    span, at = np.ptp(corners, axis=0), level[4::8, 4::8]
    assert span[at == 0].max() <= np.log(2) + 1e-6 < span.max()  # half as large at least


def test_what_cannot_be_refined(border, full):
    with pytest.raises(SweepError, match="which no shard knows"):
        Grid(PLAN, None, Shard(1, 2))
    with pytest.raises(SweepError, match="a refined sweep can't be extended"):
        extend(open_store(border), parse(FINEST, "full"), "full.toml")
    with pytest.raises(SweepError, match="a refined sweep can't be extended"):
        extend(open_store(full), PLAN, "small.toml")


def test_a_picture_says_what_was_simulated(border, small):
    plane = choose(dataset(border), x="sigma", y="Kenv", metric="nmse")
    _, simulated = words(border)
    np.testing.assert_array_equal(plane.simulated, simulated.T)
    assert plane.levels == 3 and not plane.special
    figure = draw(plane)
    (text,) = (t.get_text() for t in figure.legends[0].texts if "simulated" in t.get_text())
    assert text.startswith("simulated at corners (")
    boxes = [c for c in figure.axes[0].collections if c.get_zorder() == 1.3]
    assert boxes
    diverged = choose(dataset(small), x="K0", metric="nmse", at={"Kenv": 1e9, "contact": "welded"})
    assert diverged.special["diverged"].all()
    line = choose(dataset(small), x="K0", metric="nmse", at={"Kenv": 100.0})
    texts = [t.get_text() for t in draw(line).legends[0].texts]
    assert any("of cells simulated" in text for text in texts)


def test_a_picture_of_levels_has_whole_ticks(border, tmp_path):
    few = tmp_path / "few.zarr"
    complete(few, parse(REFINED.replace("levels = 3", "levels = 1"), "refined"))
    for path, last in ((border, 3), (few, 1)):
        bar = draw(choose(dataset(path), x="sigma", y="Kenv", metric="level")).axes[1]
        assert bar.get_ylim() == (0, last)
        assert bar.get_yticks().tolist() == list(range(last + 1))
    line = draw(choose(dataset(few), x="sigma", metric="level")).axes[0]
    assert set(line.get_yticks()) <= {-1, 0, 1, 2}
