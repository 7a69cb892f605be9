"""Stores for the tests of this folder, in memory if possible: an fsync then takes no time."""

import multiprocessing
import shutil
from pathlib import Path

import pytest

from sweeps.store.format import FORMAT
from tests.store.stores import Stores, without_engine

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="session")
def stores(shared_memory):
    folder = shared_memory / "stores"
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


@pytest.fixture(scope="module")
def processes():
    """Starts processes in which everything is imported."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.store.victim"])

    def start(target, *arguments):
        pipe, theirs = context.Pipe(duplex=False)
        process = context.Process(target=target, args=(*arguments, theirs), daemon=True)
        process.start()
        theirs.close()
        return process, pipe

    return start
