"""Warnings about sweeps that are allowed: a torque that is cut off, a plant step too long."""

import numpy as np
import pytest

from sweeps.spec.reading import parse
from sweeps.spec.warnings import warnings_of


def lines(fields):
    return list(warnings_of(parse(f'name = "a"\n[axes]\n{fields}', "f")))


def test_the_papers_scenario_gives_no_warning():
    assert lines("K0 = [50.0, 100.0]") == []


def test_a_profile_that_is_not_monotone():
    (line,) = lines("K0 = [100.0, 300.0]")
    assert "K0*x0 reaches 2 times Fmax" in line


@pytest.mark.parametrize(("Denv", "state"), [(5000.0, "unstable"), (1500.0, "inaccurate")])
def test_a_plant_step_that_is_too_long(Denv, state):
    (line,) = lines(f"Denv = [10.0, {Denv}]")
    # I s^2 + D s + K = 0 with K = Kenv + dF/b, the slope where the profile starts to saturate
    rate = np.abs(np.roots([10.0, Denv, 100.0 + (15.0 - 10.0) / (0.01 / 20.0)])).max()
    assert float(line.split()[5]) == pytest.approx(0.01 * rate, rel=0.005)  # of three digits
    assert f"RK4 is {state} there" in line
