"""Compiled programs are kept from run to run, and change no number."""

import os
from pathlib import Path

import pytest

from sweeps import compile_cache as cache
from tests.command import call

SWEEP = """
name = "kept"
[time]
t_end = 0.2
[axes]
K0 = { log = [1.0, 1000.0], n = 9 }
"""


def run(folder: Path, kept: str) -> bytes:
    """Run the sweep into a new store; returns the bytes of its metrics."""
    folder.mkdir()
    (folder / "kept.toml").write_text(SWEEP)
    environment = os.environ | {cache.VARIABLE: kept}
    call("run", "kept.toml", code=0, folder=folder, environment=environment)
    chunks = sorted((folder / "kept.zarr").glob("*/c.*"))
    assert chunks
    return b"".join(chunk.read_bytes() for chunk in chunks)


def test_a_second_run_takes_the_kept_program_and_gives_the_same_bits(tmp_path):
    kept = tmp_path / "kept"
    first = run(tmp_path / "first", str(kept))
    (program,) = kept.rglob("fic_jax-*.o")
    made = program.stat().st_mtime_ns
    assert run(tmp_path / "second", str(kept)) == first
    assert program.stat().st_mtime_ns == made
    assert run(tmp_path / "none", "") == first


@pytest.mark.parametrize("change", [lambda b: b[: len(b) // 2], lambda b: b[:99] + b"x" + b[100:]])
def test_a_spoilt_program_is_made_again(tmp_path, change):
    kept = tmp_path / "kept"
    first = run(tmp_path / "first", str(kept))
    (program,) = kept.rglob("fic_jax-*.o")
    whole = program.read_bytes()
    program.write_bytes(change(whole))
    assert run(tmp_path / "second", str(kept)) == first
    assert program.read_bytes() == whole


def test_the_folder_is_the_users_choice(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "mine"))
    assert cache.folder().parent == tmp_path / "mine"
    monkeypatch.delenv(cache.VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "all"))
    assert cache.folder().parent == tmp_path / "all" / "fic-sweep"


@pytest.mark.parametrize("kept", ["", "/proc/nowhere"])
def test_nothing_is_kept_where_it_is_not_wanted_or_can_not_be(kept, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, kept)
    assert cache.folder() is None


def test_nothing_is_kept_without_a_home(monkeypatch):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    for name in (cache.VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert cache.folder() is None
