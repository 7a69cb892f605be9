import pytest

from sweeps import runner
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import create
from sweeps.store.fsync import PARTIAL
from sweeps.store.lock import LOCK
from tests.store.stores import WHOLE


def start(path, plan=WHOLE):
    return runner.start(path, plan, 2, 32)


def test_an_existing_path_is_refused_and_untouched(tmp_path):
    path = tmp_path / "mine.zarr"
    path.mkdir()
    (path / "mine.txt").write_text("precious")
    (tmp_path / "link.zarr").symlink_to(tmp_path / "nowhere")
    for name, words in (("mine.zarr", "exists already"), ("link.zarr", "where nothing is")):
        with pytest.raises(SweepError, match=words):
            start(tmp_path / name)
    assert {p.name for p in tmp_path.rglob("*")} == {"mine.zarr", "mine.txt", "link.zarr"}


def test_a_path_is_refused_while_a_store_waits_there_for_its_extension(golden):
    """`resume` would take the new store for the extended one, and delete the old one."""
    golden.rename(create.before_extension(golden))
    with pytest.raises(SweepError, match="finishes its extension, which was cut short"):
        start(golden)


def test_an_unwritable_path_is_refused_and_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SweepError, match="can't be written: "):
        start(tmp_path / "file" / "a.zarr")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_disk_that_is_too_small_is_refused(tmp_path):
    axes = "".join(f"{n} = {{ lin = [1, 9], n = 1000 }}\n" for n in ("K0", "Kenv", "Td", "I"))
    huge = parse('name = "huge"\n[axes]\n' + axes, "f")
    with pytest.raises(SweepError, match=r"needs up to 4.1e\+04 GB for 1,000,000,000,000 cells"):
        runner.start(tmp_path / "huge.zarr", huge, None, 32)
    assert not list(tmp_path.iterdir())


def test_every_folder_made_for_a_store_is_on_the_disk(tmp_path, monkeypatch):
    """A power cut loses a folder whose name has no fsync, with everything in it."""
    synced = []
    monkeypatch.setattr(create, "sync", synced.append)
    start(tmp_path / "a" / "b" / "tiny.zarr")
    assert sorted(synced) == [tmp_path, tmp_path / "a", tmp_path / "a" / "b"]


def test_what_a_killed_process_left_is_deleted(tmp_path):
    partial = tmp_path / f".tiny.zarr{PARTIAL}"
    (partial / "nmse").mkdir(parents=True)
    (partial / "nmse" / "c.0").write_text("")
    (partial / "zarr.json").write_text("")
    (partial / "link").symlink_to(tmp_path)
    assert start(tmp_path / "tiny.zarr").rows() == []
    assert [p.name for p in tmp_path.iterdir()] == ["tiny.zarr"]


def test_a_folder_in_the_place_of_the_lock_is_deleted_for_the_next_run(tmp_path):
    (tmp_path / f".tiny.zarr{PARTIAL}" / LOCK).mkdir(parents=True)
    with pytest.raises(SweepError, match=r"tiny\.zarr: can't be written: Is a directory"):
        start(tmp_path / "tiny.zarr")
    assert not list(tmp_path.iterdir())
    assert start(tmp_path / "tiny.zarr").rows() == []
