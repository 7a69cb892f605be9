"""Stores in memory if possible: an fsync then takes no time."""

import tempfile
from pathlib import Path

import pytest


@pytest.fixture
def tmp_path(memory):
    return Path(tempfile.mkdtemp(dir=memory))
