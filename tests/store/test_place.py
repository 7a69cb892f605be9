"""A path is resolved once: every function works on the place, whatever the user typed."""

import os
import shutil
from pathlib import Path

import pytest

from sweeps import runner
from sweeps.spec.mistakes import SweepError
from sweeps.store import extend, verify
from sweeps.store.opening import dataset, open_store
from sweeps.store.place import place, place_of_new, place_of_store
from tests.store.stores import WHOLE, contents, enlarge, run


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "disk").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_path_below_here_stays_relative(here):
    Path("link").symlink_to("disk")
    for typed in ("disk/a", "./disk/a", "x/../disk/a", "disk//a/", "link/a", Path("disk/a")):
        assert place(typed) == Path("disk/a")
    for typed in (here / "disk" / "a", "../other", ".", "..", "/"):
        assert place(typed) == Path(os.path.realpath(typed))
    assert place(".") == here


def test_home_is_expanded(here, monkeypatch):
    """bash expands no `~` in `--out=~/a.zarr`."""
    monkeypatch.setenv("HOME", str(here / "disk"))
    assert place("~/a.zarr") == here / "disk" / "a.zarr"


@pytest.mark.parametrize("typed", ["", " ", "a\nb", "a\tb", "\x1b[2J", "a\u2028b"])
def test_what_is_no_name_is_refused_in_one_line(here, typed):
    for resolve in (place, place_of_store, place_of_new):
        with pytest.raises(SweepError, match=r"empty|no control characters") as refused:
            resolve(typed)
        assert len(str(refused.value).splitlines()) == 1


def test_a_store_must_have_a_name(here):
    with pytest.raises(SweepError, match="is no result store"):
        place_of_store("/")


def test_a_deleted_folder_is_refused(here, monkeypatch):
    monkeypatch.chdir("disk")
    (here / "disk").rmdir()
    try:
        with pytest.raises(SweepError, match="the folder that you are in was deleted"):
            place("a.zarr")
    finally:
        os.chdir(here)


@pytest.mark.parametrize("name", ["link", "link/a.zarr", "loop", "loop/a.zarr"])
def test_a_link_to_nothing_is_no_place_for_a_new_store(here, quick, name):
    Path("link").symlink_to("nowhere")
    Path("loop").symlink_to("loop")
    with pytest.raises(SweepError, match=r"is a link to .*, where nothing is"):
        runner.start(Path(name), WHOLE, 2, 32)
    assert {p.name for p in here.iterdir()} == {"disk", "link", "loop"}


def test_a_store_behind_a_link_grows_in_its_place(here, stores, quick):
    """The link was replaced by a folder, and the old store stayed as `.small.zarr.before`."""
    shutil.copytree(stores.folder / "small", here / "disk" / "small.zarr")
    Path("link.zarr").symlink_to("disk/small.zarr")
    enlarge(Path("link.zarr"))
    run(open_store(Path("link.zarr")))
    assert Path("link.zarr").is_symlink()
    assert [p.name for p in (here / "disk").iterdir()] == ["small.zarr"]
    assert contents(here / "disk" / "small.zarr") == stores.expected[5]


def test_every_function_takes_the_folder_one_is_in(here, stores, quick, monkeypatch):
    shutil.copytree(stores.folder / "small", here / "small.zarr")
    monkeypatch.chdir("small.zarr")
    extend.recover(Path("."))
    assert open_store(Path(".")).path == here / "small.zarr"
    assert dataset(Path(".")).sizes == {"K0": 3}
    assert not verify.verify(Path(".")).problems
    verify.repair_metadata(Path("."))
    enlarge(Path("."))
    os.chdir(here)
    run(open_store(Path("small.zarr")))
    assert contents(Path("small.zarr")) == stores.expected[5]


def test_folders_made_for_a_store_go_if_it_can_not_be_made(here, quick):
    with pytest.raises(SweepError, match="can't be written: File name too long"):
        runner.start(here / "new" / "folder" / ("x" * 250), WHOLE, 2, 32)
    assert [p.name for p in here.iterdir()] == ["disk"]
