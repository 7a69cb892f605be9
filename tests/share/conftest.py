"""A store to share, small enough to be made anew."""

import pytest

from tests.explore.conftest import ran
from tests.pages import browser  # noqa: F401  a fixture

EVIL = "</script><img src=x onerror=\"document.title='run'\"><b>A joint</b> & 'more'"
JOINT = f"""
name = "joint"
description = {EVIL!r}
error_estimate = true
[time]
t_end = 0.5
[model]
contact = ["hard_stop", "welded"]
[constants]
I = 5.0
[axes]
K0 = {{ log = [10.0, 1000.0], n = 9 }}
Kenv = {{ log = [100.0, 10.0], n = 8 }}
Td = [1.0, 5.0, 12.0]
""".replace(repr(EVIL), "'''" + EVIL + "'''")


@pytest.fixture(scope="session")
def joint(tmp_path_factory):
    """A finished store of a choice and three axes, one of them descending."""
    return ran(tmp_path_factory.mktemp("joint") / "joint.zarr", JOINT, chunk=80)
