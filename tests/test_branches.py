"""What the store, the ledger, the lock and a run do in the cases that no other test comes by."""

import json
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import jax
import numpy as np
import pytest

from sweeps import compile_cache, runner
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import commit, extend, ledger
from sweeps.store import format as layout
from sweeps.store import fsync as durable
from sweeps.store import lock as owner
from sweeps.store import opening as store
from tests.changed import note
from tests.test_golden import GOLDEN, PLAN


@pytest.fixture
def golden(tmp_path):
    return Path(shutil.copytree(GOLDEN / "format-2.zarr", tmp_path / "golden.zarr"))


def damage(path):
    path.write_bytes(path.read_bytes()[:-1] + b"?")


def test_files_are_as_they_were_where_one_can_not_be_written(tmp_path):
    (tmp_path / "a").write_bytes(b"before")
    with pytest.raises(FileNotFoundError):
        durable.write({tmp_path / "a": b"after", tmp_path / "none" / "b": b"after"})
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a", b"before")]


def test_a_second_owner_is_told_who_the_first_is(tmp_path):
    with owner.owning(tmp_path), pytest.raises(SweepError) as refused:
        owner.owning(tmp_path).__enter__()
    assert f"is being changed by process {os.getpid()} on " in str(refused.value)


def test_a_block_is_kept_only_as_it_was_committed(golden):
    opened = store.open_store(golden)
    row = next(row for row in opened.rows() if row.ok)
    known = commit.kept(opened, row)
    assert known is not None
    assert np.all(known["status"] == store.OK)
    damage(opened.file("nmse", row.block))
    assert commit.kept(opened, row) is None


def test_a_folder_that_became_a_link_is_not_written_to(golden):
    opened = store.open_store(golden)
    (golden / "nmse").rename(golden.parent / "elsewhere")
    (golden / "nmse").symlink_to(golden.parent / "elsewhere")
    with pytest.raises(SweepError, match="its nmse is a link"), commit.changing(opened):
        pass


def test_a_row_that_is_no_row_is_damage(golden):
    """Its checksum is right: only what it says is not."""
    place = golden / "ledger.sqlite"
    with closing(sqlite3.connect(place)) as database, database:
        values = ("Td/c.5", "{", None, ledger._digest("Td/c.5", "{"))
        database.execute("INSERT INTO fixed VALUES (?, ?, ?, ?)", values)
    with pytest.raises(ledger.LedgerError, match=r"the row of Td/c\.5 is not as it was written"):
        list(ledger.Ledger(place).fixed())


def test_a_database_whose_index_lost_its_rows_is_damage(golden):
    """Every row still has its checksum."""
    place = golden / "ledger.sqlite"
    (golden / ledger.SEAL).unlink()
    with closing(sqlite3.connect(place)) as database:
        query = "SELECT rootpage FROM sqlite_schema WHERE type = 'index'"
        ((page,),) = database.execute(query).fetchall()
    content = bytearray(place.read_bytes())
    content[(page - 1) * 4096 : page * 4096] = b"\x0a\0\0\0\0\x10\0\0".ljust(4096, b"\0")
    place.write_bytes(content)
    with pytest.raises(ledger.LedgerError, match="index"):
        ledger.Ledger(place).check()


def test_a_variable_that_is_gone_is_told(golden):
    shutil.rmtree(golden / "nmse")
    with pytest.raises(SweepError, match="lacks nmse/"):
        store.open_store(golden).refuse_missing()
    record = json.loads((golden / "zarr.json").read_text())
    del record["consolidated_metadata"]["metadata"]["nmse"]
    (golden / "zarr.json").write_text(json.dumps(record))
    with pytest.raises(SweepError, match="its variable nmse is not the one of its sweep"):
        store.open_store(golden)


def test_a_block_half_on_the_disk_is_told(golden):
    """Renamed in any order by a power cut: its status is there, its numbers are not."""
    opened = store.open_store(golden)
    shutil.copy(opened.file("status", 0), opened.file("status", 3))
    with pytest.raises(SweepError, match=r"half written; `fic-sweep resume .* writes them"):
        store.dataset(golden)


def test_format_1_without_estimates_is_counted(tmp_path):
    path = Path(shutil.copytree(GOLDEN / "format-1.zarr", tmp_path / "golden.zarr"))
    record = json.loads((path / "zarr.json").read_text())
    record["attributes"]["error_estimate"] = 0
    (path / "zarr.json").write_text(json.dumps(record))
    assert store.Tally.of(store.open_store(path)).cells["ok"] == 6
    assert store.Tally.of(store.open_store(path)).trusted == 0


@pytest.mark.parametrize("new", [True, False])
def test_an_extension_that_was_cut_short_is_finished_or_undone(golden, new):
    before = extend.away(golden)
    if new:
        shutil.copytree(golden, before)
    else:
        golden.rename(before)
    extend.recover(golden)
    assert store.open_store(golden).rows()
    assert not before.exists()


def test_what_is_no_store_replaces_none(golden):
    """Something else under its name: the one that waits must stay."""
    before = extend.away(golden)
    golden.rename(before)
    golden.mkdir()
    extend.recover(golden)
    assert store.open_store(before).rows()


def test_a_store_that_another_process_changed_is_not_written_to(golden):
    opened = store.open_store(golden)
    note(golden, block_cells=3)
    with pytest.raises(SweepError, match="was changed by another process"), commit.changing(opened):
        pass


def test_a_file_under_way_is_no_part_of_what_is_read(golden):
    (golden / "nmse" / f"c.0.0.0{durable.PARTIAL}").write_bytes(b"half")
    assert store.dataset(golden)["nmse"].shape == store.open_store(golden).grid.shape


def test_a_damaged_store_is_not_extended(golden):
    """Two whole files in each other's place would pass for the numbers of other scenarios."""
    opened = store.open_store(golden)
    first, last = (opened.file("nmse", block) for block in (0, 2))
    one, other = first.read_bytes(), last.read_bytes()
    first.write_bytes(other)
    last.write_bytes(one)
    larger = parse(PLAN.replace("5.0, 20.0", "5.0, 20.0, 30.0"), "larger.toml")
    with pytest.raises(SweepError, match="2 files of finished blocks are not as written"):
        extend.extend(opened, larger, "larger.toml")
    assert store.open_store(golden).grid == opened.grid
    assert os.listdir(golden.parent) == [golden.name]


CASES = """
name = "begun"
metrics = ["nmse"]
[cases]
Denv = [0.0, 63.2]
gap = [0.0, 0.1]
"""
DRAWN = """
name = "begun"
metrics = ["nmse"]
[sample]
n = 8
method = "lhs"
ranges = { Td = { lin = [1.0, 5.0] }, K0 = { log = [1.0, 100.0] } }
"""
SAMPLE = DRAWN[DRAWN.index("[sample]") :]
ADDED = "`sample` can't be added: its scenarios are not those of the store."
STAY = "`Denv` must stay where it is in the store's sweep."
ORDER = "`sample.ranges` must be in the store's order: a range is drawn by its place."
NOT_LARGER = {
    "other metrics": (
        CASES,
        CASES.replace("nmse", "energy_in"),
        ["`metrics` must be those of the store, ['nmse']."],
    ),
    "two things": (
        CASES,
        "error_estimate = true" + CASES.replace('"nmse"', '"nmse", "energy_in"'),
        [
            "`error_estimate` must be that of the store, False.",
            "`metrics` must be those of the store, ['nmse'].",
        ],
    ),
    "lacks the default": (
        CASES,
        CASES + "[axes]\nK0 = [10.0, 20.0]",
        ["`K0` must contain K0 = 100.0, which the store was run with."],
    ),
    "case to axis": (
        CASES,
        CASES.replace("Denv = [0.0, 63.2]\n", "") + "[axes]\nDenv = [0.0, 63.2]",
        [STAY],
    ),
    "case to nothing": (CASES, CASES.replace("Denv = [0.0, 63.2]\n", ""), [STAY]),
    "a sample of cases": (CASES, CASES + SAMPLE, [ADDED]),
    "length of a hypercube": (
        DRAWN,
        DRAWN.replace("n = 8", "n = 9"),
        ["`sample.n` can't be changed with lhs: every scenario depends on it."],
    ),
    "order of ranges": (
        DRAWN,
        DRAWN.replace("Td = { lin = [1.0, 5.0] }, ", "").replace(
            "100.0] } }", "100.0] }, Td = { lin = [1.0, 5.0] } }"
        ),
        [ORDER],
    ),
}


@pytest.mark.parametrize(("begun", "asked", "told"), NOT_LARGER.values(), ids=NOT_LARGER)
def test_a_sweep_that_lacks_what_the_store_has_is_refused(tmp_path, begun, asked, told):
    made = runner.start(tmp_path / "begun.zarr", parse(begun, "begun.toml"), None, 32)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SweepError) as refused:
        extend.extend(made, parse(asked, "larger.toml"), "larger.toml")
    assert str(refused.value).splitlines() == [f"larger.toml: {line}" for line in told]
    assert sorted(tmp_path.rglob("*")) == before


def test_every_folder_made_for_a_store_is_on_the_disk(tmp_path, monkeypatch):
    """A power cut takes a folder whose name was not flushed, with all that is in it."""
    flushed = []
    monkeypatch.setattr(layout, "sync", flushed.append)
    runner.start(tmp_path / "a" / "b" / "begun.zarr", parse(CASES, "begun.toml"), None, 32)
    assert sorted(flushed) == [tmp_path, tmp_path / "a", tmp_path / "a" / "b"]


def test_a_place_that_can_not_be_owned_is_cleared_for_the_next_run(tmp_path):
    """There is a folder where the lock belongs."""
    path, plan = tmp_path / "begun.zarr", parse(CASES, "begun.toml")
    (tmp_path / f".begun.zarr{durable.PARTIAL}" / owner.NAME).mkdir(parents=True)
    with pytest.raises(SweepError, match=r"begun\.zarr: can't be written: Is a directory"):
        runner.start(path, plan, None, 32)
    assert not list(tmp_path.iterdir())
    assert runner.start(path, plan, None, 32).rows() == []


@pytest.fixture
def fresh(monkeypatch):
    """JAX as it is before a run sets it up, and afterwards as the tests have it."""
    names = (
        "jax_platforms",
        "jax_enable_x64",
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
    )
    before = {name: getattr(jax.config, name) for name in names}
    # it sets what can't be set once JAX has started, and has its own tests
    monkeypatch.setattr(runner, "tune_for_throughput", lambda: None)
    jax.config.update("jax_compilation_cache_dir", None)
    yield jax.config
    for name, value in before.items():
        jax.config.update(name, value)


def test_a_run_has_the_precision_and_the_device_it_asks_for(fresh):
    preferred = fresh.jax_platforms
    for precision in (32, 64):
        runner.configure(precision)
        assert fresh.jax_enable_x64 == (precision == 64)
        assert fresh.jax_platforms == preferred
    runner.configure(32, "cpu")
    assert fresh.jax_platforms == "cpu"


def test_a_device_that_is_not_there_is_refused(fresh):
    """Not by a name that some machine answers to."""
    with pytest.raises(SweepError, match=r"^JAX [\d.]+ finds no abacus here; a GPU needs a driver"):
        runner.configure(32, "abacus")


def test_a_gpu_that_is_there_is_left_to_jax(fresh, monkeypatch):
    """JAX prefers it anyway; the processor stays for what is not put on it."""
    preferred = fresh.jax_platforms
    monkeypatch.setattr(jax, "devices", lambda platform: {"gpu": ["there"]}[platform])
    runner.configure(32, "gpu")
    assert fresh.jax_platforms == preferred


def test_what_xla_compiles_is_kept_with_our_programs_or_where_the_user_says(
    fresh, monkeypatch, tmp_path
):
    monkeypatch.setenv(compile_cache.VARIABLE, "")
    runner.configure(32)
    assert fresh.jax_compilation_cache_dir is None
    monkeypatch.setenv(compile_cache.VARIABLE, str(tmp_path / "ours"))
    runner.configure(32)
    assert fresh.jax_compilation_cache_dir == str(compile_cache.folder())
    assert fresh.jax_persistent_cache_min_compile_time_secs == 0.2
    fresh.update("jax_compilation_cache_dir", str(tmp_path / "theirs"))
    runner.configure(32)
    assert fresh.jax_compilation_cache_dir == str(tmp_path / "theirs")
