"""Whose bits: a program that would write others continues and repairs no store."""

import shutil

import pytest

from sweeps import provenance, runner
from sweeps.store.opening import open_store
from tests.command import typed

OTHERS = {  # attribute -> what another machine or installation would say
    "arithmetic": "lanes unfused",
    "llvmlite": "",
    "ranges": 1,
    "numpy": "1.0",
    "xla_flags": "--xla_allow_excess_precision=true",
}


@pytest.fixture
def damaged(ran, tmp_path, monkeypatch):
    """A copy of a store with a damaged file, in the working directory."""
    shutil.copytree(ran / "tiny.zarr", tmp_path / "tiny.zarr")
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "tiny.zarr" / "nmse" / "c.0.0"
    file.write_bytes(file.read_bytes()[::-1])
    return file


@pytest.mark.parametrize(("key", "value"), OTHERS.items())
@pytest.mark.parametrize("command", [("resume", "tiny.zarr"), ("verify", "tiny.zarr", "--repair")])
def test_another_arithmetic_is_refused_by_name(damaged, monkeypatch, command, key, value):
    here = provenance.provenance(32)
    monkeypatch.setattr(runner, "provenance", lambda precision: here | {key: value})
    before = damaged.read_bytes()
    ended = typed(*command)
    assert ended.code == 2
    assert (
        f"tiny.zarr: was begun by another program ({key} was {here[key]}, is {value or 'none'})"
        in (ended.stderr)
    )
    assert damaged.read_bytes() == before
    assert open_store(damaged.parent.parent).rows()  # its ledger has the block as it was


def test_a_repair_that_writes_other_bits_says_so_and_fails(damaged, monkeypatch):
    """Two processors may differ in a way that no attribute records."""
    compute = runner._compute

    def other(*arguments):
        metrics, errors = compute(*arguments)
        metrics.nmse[0] *= 1 + 1e-6
        return metrics, errors

    monkeypatch.setattr(runner, "_compute", other)
    ended = typed("verify", "tiny.zarr", "--repair")
    assert ended.code == 1
    assert "block 0 came out different; the store has its new numbers" in ended.stderr
