"""Stores in memory if possible: an fsync then takes no time."""

import os
import tempfile
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def memory():
    place = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=place, prefix="fic-sweep-") as folder:
        yield Path(folder)


@pytest.fixture
def tmp_path(memory):
    return Path(tempfile.mkdtemp(dir=memory))
