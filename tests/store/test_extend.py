"""Larger sweeps: those that are refused, and how an extension ends. `test_state_machine` checks the
numbers of random extensions."""

import os
import shutil

import pytest

from sweeps import runner
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import extend
from sweeps.store.create import before_extension
from sweeps.store.opening import Counts, open_store
from tests.store.test_golden import LARGER


@pytest.mark.parametrize("new", [True, False])
def test_recover_finishes_or_undoes_an_extension(golden, new):
    before = before_extension(golden)
    if new:
        shutil.copytree(golden, before)
    else:
        golden.rename(before)
    extend.recover(golden)
    assert open_store(golden).rows()
    assert not before.exists()


def test_recover_keeps_notes(golden):
    """A kill may come before they are moved."""
    before = before_extension(golden)
    shutil.copytree(golden, before)
    (before / "notes.txt").write_text("mine")
    extend.recover(golden)
    assert (golden / "notes.txt").read_text() == "mine"
    assert not before.exists()


def test_recover_leaves_what_is_no_store(golden):
    """Something else has the name: the waiting store must stay."""
    before = before_extension(golden)
    golden.rename(before)
    golden.mkdir()
    extend.recover(golden)
    assert open_store(before).rows()


def test_an_extension_keeps_what_made_the_numbers(golden):
    """And nothing that belongs to the smaller sweep: it has not ended."""
    before = open_store(golden).group.attrs.asdict()
    after = extend.extend(open_store(golden), LARGER, "larger.toml").group.attrs.asdict()
    assert {k for k in after if after[k] != before.get(k)} == {
        *("sweep", "sweep_sha256", "extended"),
        *("held", "held_by_default"),  # which the golden store does not have
    }
    assert set(before) - set(after) == set()


def test_a_damaged_store_is_not_extended(golden):
    """Two whole files in each other's place would become the numbers of other scenarios."""
    store = open_store(golden)
    first, last = (store.file("nmse", block) for block in (0, 2))
    one, other = first.read_bytes(), last.read_bytes()
    first.write_bytes(other)
    last.write_bytes(one)
    with pytest.raises(SweepError, match="2 files of finished blocks are not as written"):
        extend.extend(store, LARGER, "larger.toml")
    assert open_store(golden).grid == store.grid
    assert os.listdir(golden.parent) == [golden.name]


def test_cells_of_a_block_without_a_row_are_not_copied(golden):
    """A kill between files and row: nothing guarantees what the files contain."""
    store = open_store(golden)
    before = Counts.of(store).cells
    for name in store.variables:
        shutil.copy(store.file(name, 0), store.file(name, 3))
    larger = extend.extend(store, LARGER, "larger.toml")
    after = Counts.of(larger).cells
    assert (after["ok"], after["diverged"]) == (before["ok"], before["diverged"])


CASES = """
name = "begun"
metrics = ["nmse"]
[cases]
Denv = [0.0, 63.2]
gap = [0.0, 0.1]
"""
AXES = """
name = "begun"
metrics = ["nmse"]
constants.I = 9.0
[model]
contact = ["welded", "hard_stop"]
[axes]
K0 = [1.0, 2.0]
Td = [5.0, 6.0]
"""
SAMPLE = """
[sample]
n = 8
method = "lhs"
ranges = { Td = { lin = [1.0, 5.0] }, K0 = { log = [1.0, 100.0] } }
"""
DRAWN = 'name = "begun"\nmetrics = ["nmse"]' + SAMPLE
TD, K0 = "Td = { lin = [1.0, 5.0] }", "K0 = { log = [1.0, 100.0] }"
STAY = "`Denv` must stay where it is in the store's sweep."
ANOTHER = "must be that of the store: another one is another sample."
NOT_LARGER = {
    "metrics": (CASES, ("nmse", "energy_in"), ["`metrics` must be those of the store, ['nmse']."]),
    "time": (CASES, ("[cases]", "time.dt=0.005\n[cases]"), [
        "`time` must be that of the store, dt=0.01 t_end=10.0."]),
    "precision": (CASES, ('["nmse"]', '["nmse"]\nprecision = 64'), [
        "`precision` must be that of the store, 32."]),
    "two things": (CASES, ('["nmse"]', '["nmse", "energy_in"]\nerror_estimate = true'), [
        "`error_estimate` must be that of the store, False.",
        "`metrics` must be those of the store, ['nmse']."]),
    "lacks the default": (CASES, ("[cases]", "[axes]\nK0 = [10.0, 20.0]\n[cases]"), [
        "`K0` must contain K0 = 100.0, which the store was run with."]),
    "lacks a case": (CASES, ("[0.0, 63.2]", "[0.0, 63.3]"), [
        "`case` must keep what the store has, but lacks Denv = 63.2, gap = 0.1."]),
    "case to axis": (CASES, ("[cases]\nDenv = [0.0, 63.2]", "axes.Denv=[0.0, 63.2]\n[cases]"), [
        STAY]),
    "case to nothing": (CASES, ("Denv = [0.0, 63.2]\n", ""), [STAY]),
    "constant": (AXES, ("9.0", "11.0"), [
        "`I` must stay 9.0, as in the store, or be an axis with 9.0 in it."]),
    "lacks a value": (AXES, ("[1.0, 2.0]", "[1.0, 3.0]"), [
        "`K0` must keep what the store has, but lacks K0 = 2.0."]),
    "lacks an axis": (AXES, ("K0 = [1.0, 2.0]", ""), [
        "`K0` must stay a dimension: the store has 2 places along it."]),
    "lacks a choice": (AXES, ('["welded", "hard_stop"]', '["welded"]'), [
        "`contact` must keep what the store has, but lacks contact = hard_stop."]),
    "adds a sample": (CASES, ("gap = [0.0, 0.1]", "gap = [0.0, 0.1]" + SAMPLE), [
        "`sample` can't be added: its scenarios are not those of the store."]),
    "method": (DRAWN, ("lhs", "sobol"), [f"`sample.method` {ANOTHER}"]),
    "seed": (DRAWN, ("n = 8", "n = 8\nseed = 4"), [f"`sample.seed` {ANOTHER}"]),
    "ranges": (DRAWN, ("5.0", "6.0"), [f"`sample.ranges` {ANOTHER}"]),
    "order of ranges": (DRAWN, (f"{TD}, {K0}", f"{K0}, {TD}"), [
        "`sample.ranges` must be in the store's order: a range is drawn by its place."]),
    "length of a hypercube": (DRAWN, ("n = 8", "n = 9"), [
        "`sample.n` can't be changed with lhs: every scenario depends on it."]),
}  # fmt: skip


@pytest.mark.parametrize(("begun", "change", "reasons"), NOT_LARGER.values(), ids=NOT_LARGER)
def test_a_sweep_that_is_not_larger_is_refused(tmp_path, begun, change, reasons):
    store = runner.start(tmp_path / "begun.zarr", parse(begun, "begun.toml"), None, 32)
    assert change[0] in begun
    larger = parse(begun.replace(*change), "larger.toml")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SweepError) as refused:
        extend.extend(store, larger, "larger.toml")
    assert str(refused.value).splitlines() == [f"larger.toml: {reason}" for reason in reasons]
    assert sorted(tmp_path.rglob("*")) == before
