"""A later run loads the compiled program from the cache; the cache changes no number."""

import os
import shutil
from pathlib import Path

import pytest

from sweeps import compile_cache
from tests.command import call

SWEEP = """
name = "cached"
[time]
t_end = 0.2
[axes]
K0 = { log = [1.0, 1000.0], n = 9 }
"""


def run(folder: Path, cache: str) -> bytes:
    """Run the sweep into a new store; returns the bytes of its numbers."""
    folder.mkdir()
    (folder / "cached.toml").write_text(SWEEP)
    environment = os.environ | {compile_cache.VARIABLE: cache}
    call("run", "cached.toml", code=0, folder=folder, environment=environment)
    chunks = sorted((folder / "cached.zarr").glob("*/c.*"))
    assert chunks
    return b"".join(chunk.read_bytes() for chunk in chunks)


def program_in(cache: Path) -> Path:
    (program,) = cache.rglob("*.o")
    return program


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The cache after one run, and the numbers of that run."""
    folder = tmp_path_factory.mktemp("first")
    return folder / "cache", run(folder / "run", str(folder / "cache"))


@pytest.fixture
def cache(first, tmp_path):
    return Path(shutil.copytree(first[0], tmp_path / "cache"))


def test_a_second_run_loads_the_program_and_gives_the_same_numbers(first, cache, tmp_path):
    written = program_in(cache).stat().st_mtime_ns
    assert run(tmp_path / "second", str(cache)) == first[1]
    assert program_in(cache).stat().st_mtime_ns == written


def test_a_run_without_a_cache_gives_the_same_numbers(first, tmp_path):
    assert run(tmp_path / "none", "") == first[1]


@pytest.mark.parametrize(
    "change", [lambda b: b[: len(b) // 2], lambda b: b[:99] + b"x" + b[100:]], ids=["cut", "byte"]
)
def test_a_damaged_program_is_compiled_again(first, cache, tmp_path, change):
    whole = program_in(cache).read_bytes()
    program_in(cache).write_bytes(change(whole))
    assert run(tmp_path / "second", str(cache)) == first[1]
    assert program_in(cache).read_bytes() == whole


def test_the_user_chooses_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv(compile_cache.VARIABLE, str(tmp_path / "mine"))
    assert compile_cache.folder().parent == tmp_path / "mine"
    monkeypatch.delenv(compile_cache.VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "all"))
    assert compile_cache.folder().parent == tmp_path / "all" / "fic-sweep"


def test_a_path_is_expanded_as_a_shell_would(tmp_path, monkeypatch):
    """A job's file or a container sets the variable without a shell; a folder `~` was made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for value in ("~/mine", "$HOME/mine", "${HOME}/mine"):
        monkeypatch.setenv(compile_cache.VARIABLE, value)
        assert compile_cache.folder().parent == tmp_path / "home" / "mine"
    monkeypatch.delenv(compile_cache.VARIABLE)
    for value, folder in (("~/all", "home/all"), ("relative", "home/.cache"), ("", "home/.cache")):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert compile_cache.folder().parent == tmp_path / folder / "fic-sweep"
    assert [p.name for p in tmp_path.iterdir()] == ["home"]


def test_the_empty_name_switches_the_cache_off(monkeypatch):
    monkeypatch.setenv(compile_cache.VARIABLE, "")
    assert compile_cache.folder() is None


@pytest.mark.parametrize(
    ("folder", "why"),
    [
        ("/proc/nowhere", "No such file or directory"),
        ("$NOWHERE/a", "names a variable or a user that is not known"),
        ("~nobody-of-this-name/a", "names a variable or a user that is not known"),
        ("file/a", "Not a directory"),
    ],
)
def test_a_folder_that_can_not_be_used_is_named_in_a_warning(folder, why, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(compile_cache.VARIABLE, folder)
    with pytest.warns(RuntimeWarning, match=why):
        assert compile_cache.folder() is None
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_no_home_no_cache(monkeypatch):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    for name in (compile_cache.VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    assert compile_cache.folder() is None
