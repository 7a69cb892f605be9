"""Stores to explore, small enough to be made anew."""

import numpy as np
import pytest

from sweeps import runner
from sweeps.spec.reading import parse
from tests.pages import browser  # noqa: F401  a fixture

CUBE = """
name = "cube"
error_estimate = true
[time]
t_end = 0.5
[model]
contact = ["hard_stop", "welded"]
[axes]
K0 = { log = [10.0, 1000.0], n = 5 }
Kenv = { log = [100.0, 10.0], n = 4 }
Td = [1.0, 5.0, 12.0]
"""


def ran(path, text, chunk=None, blocks=None):
    """A store of a sweep file, or of some of its blocks."""
    plan = parse(text, "sweep.toml")
    store = runner.start(path, plan, chunk, plan.bits)
    runner.run(store, lambda _: None, only=blocks)
    return path


@pytest.fixture(scope="session")
def cube(tmp_path_factory):
    """A finished store of a choice and three axes."""
    return ran(tmp_path_factory.mktemp("cube") / "cube.zarr", CUBE, chunk=12)


@pytest.fixture
def strict():
    """NumPy as errors: a picture of NaN must not warn."""
    with np.errstate(all="raise", under="ignore"):
        yield
