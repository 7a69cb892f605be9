"""Stores for the tests of this folder, in memory if possible: an fsync then takes no time."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest

from sweeps.store.format import FORMAT
from tests.store.stores import Stores, without_engine

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="session")
def memory():
    place = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=place, prefix="fic-sweep-") as folder:
        yield Path(folder)


@pytest.fixture(scope="session")
def stores(memory):
    folder = memory / "stores"
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        without_engine(patch)
        return Stores(folder)


@pytest.fixture
def quick(monkeypatch):
    without_engine(monkeypatch)


@pytest.fixture
def golden(tmp_path):
    """A copy of the golden store of today's format, to be changed."""
    return Path(shutil.copytree(GOLDEN / f"format-{FORMAT}.zarr", tmp_path / "golden.zarr"))
