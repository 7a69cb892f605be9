"""Warnings about sweeps that are allowed: a torque that is cut off, a plant step too long."""

import re

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


def test_a_step_that_the_warning_recommends_has_no_such_warning():
    """It divides t_end and the periods; a period that was the default stays so."""
    fields = "Kenv = [10.0, 2000.0]\nperiod = [0.01, 0.03]\n[constants]\nI = 0.1\nDenv = 7.0"
    text = f'name = "a"\n[time]\nt_end = 3.0\n[axes]\n{fields}'
    (line,) = warnings_of(parse(text, "f"))
    (setting,) = re.findall(r"`--set (dt=[^`]*)`", line)
    assert not list(warnings_of(parse(text, "f", (setting,))))
    assert float(setting.removeprefix("dt=")) > 0.01 / 8  # no shorter than needed


def test_no_step_is_recommended_that_makes_too_many():
    text = 'name = "a"\n[time]\nt_end = 1e5\n[axes]\nDenv = [1e9]'
    (line,) = warnings_of(parse(text, "f"))
    assert "would do" not in line


def test_a_controller_slower_than_the_plant_step_is_named():
    """`period` keeps its default of 10 ms when dt is made shorter."""
    text = 'name = "a"\n[time]\ndt = 0.001\n[axes]\nK0 = [50.0]'
    (line,) = warnings_of(parse(text, "f"))
    assert "the controller runs every 0.01 s, the default of `period`" in line
    (setting,) = re.findall(r"`--set (period=[^`]*)`", line)
    assert not list(warnings_of(parse(text, "f", (setting,))))
    assert not list(warnings_of(parse(text, "f", ("period=0.01",))))  # it was named


def test_a_torque_that_can_not_be_reached():
    (line,) = lines("Td = [4.0, -20.0]")
    assert "Td reaches 20 N*m, but the torque is limited to Fmax = 15 N*m" in line
    assert lines("Td = [4.0, -20.0]\nFmax = [20.0, 30.0]") == []


def test_values_that_the_precision_does_not_tell_apart():
    (line,) = lines("K0 = [50.0, 50.0000001, 60.0]")
    assert line == (
        "K0 = 50 and 50.0000001 are one number in 32 bits; `--precision 64` tells them apart"
    )
    assert not list(
        warnings_of(parse('name = "a"\nprecision = 64\n[axes]\nK0 = [50.0, 50.0000001]', "f"))
    )
