import shutil

import numpy as np
import pytest

from sweeps.spec.mistakes import SweepError
from sweeps.store import commit
from sweeps.store.format import OK
from sweeps.store.fsync import PARTIAL
from sweeps.store.opening import open_store
from tests.store.faults import Calls
from tests.store.stores import change_attributes, enlarge, flip, run


def test_the_order_of_a_commit(stores, quick):
    """All files, then all names, then the folders, then the row."""
    with stores.case() as path:
        stores.create(path)
        with Calls(path) as disk:
            run(open_store(path))
    variables = ("nmse", "peak_torque", "status")
    files = [f"{name}/c.0" for name in variables]
    made = [(call.name, call.path.removeprefix(f"{path}/")) for call in disk.made]
    wanted = [("write", name + PARTIAL) for name in files]
    wanted += [("fsync", name + PARTIAL) for name in files]
    wanted += [("commit", "ledger.sqlite")]  # the old row is deleted
    wanted += [("replace", name + PARTIAL) for name in files]
    wanted += [("fsync", name) for name in variables] + [("commit", "ledger.sqlite")]
    first = made.index(wanted[0])
    steps = [call for call in made[first:] if call in wanted]
    assert steps[: len(wanted)] == wanted


def test_a_block_is_read_only_as_it_was_committed(golden):
    store = open_store(golden)
    row = next(row for row in store.rows() if row.ok)
    values = commit.read_block(store, row)
    assert values is not None
    assert np.all(values["status"] == OK)
    flip(store.file("nmse", row.block), 99)
    assert commit.read_block(store, row) is None


@pytest.mark.parametrize("name", ["nmse", "status", "ledger.sqlite"])
def test_a_store_with_a_link_is_not_written_to(golden, name):
    store = open_store(golden)
    (golden / name).rename(golden.parent / "elsewhere")
    (golden / name).symlink_to(golden.parent / "elsewhere")
    with pytest.raises(SweepError, match=f"its {name} is a link"), commit.writing(store):
        pass


@pytest.mark.parametrize("change", [enlarge, lambda path: change_attributes(path, block_cells=3)])
def test_a_store_that_another_process_changed_is_not_written_to(stores, quick, change):
    with stores.case("small") as path:
        store = open_store(path)
        change(path)
        with pytest.raises(SweepError, match="was changed by another process; try again"):
            run(store)


def test_a_writer_deletes_partial_files_but_not_through_a_link(golden):
    elsewhere = golden.parent / "elsewhere"
    shutil.copytree(golden / "nmse", elsewhere)
    (golden / "other").symlink_to(elsewhere)
    for folder in (golden, golden / "nmse", elsewhere):
        (folder / f"c.0.0.0{PARTIAL}").write_text("half")
    with commit.writing(open_store(golden)):
        assert not (golden / "ledger.sha256").exists()
    assert list(golden.parent.rglob(f"*{PARTIAL}")) == [elsewhere / f"c.0.0.0{PARTIAL}"]
    assert (golden / "ledger.sha256").exists()
