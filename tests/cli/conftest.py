"""A folder with a small sweep file, and one where the sweep has been run."""

import pytest

from tests.command import call

TINY = """
name = "tiny"
[time]
t_end = 0.5
[axes]
K0 = { log = [1.0, 100.0], n = 4 }
Td = [1.0, 5.0, 12.0]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with tiny.toml."""
    (tmp_path / "tiny.toml").write_text(TINY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def first_run(tmp_path_factory):
    """A folder with tiny.toml and tiny.zarr, and what `run` printed."""
    path = tmp_path_factory.mktemp("ran")
    (path / "tiny.toml").write_text(TINY)
    return path, call("run", "tiny.toml", code=0, folder=path)


@pytest.fixture
def ran(first_run, monkeypatch):
    """The working directory, with tiny.toml and tiny.zarr; tests read them only."""
    monkeypatch.chdir(first_run[0])
    return first_run[0]
