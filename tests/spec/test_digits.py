"""Printed numbers differ where the numbers do."""

import numpy as np
import pytest

from sweeps.spec.digits import MOST, digits


def printed(values):
    n = digits(values)
    return [f"{value:.{n}g}" for value in values]


@pytest.mark.parametrize(
    ("values", "texts"),
    [
        ([1000.0, 1000.25, 1000.5], ["1000", "1000.25", "1000.5"]),
        ([1.0, 10.0, 1000.0], ["1", "10", "1000"]),
        ([1000.25, 2000.0], ["1000.25", "2000"]),  # a short decimal is printed whole
        ([1000.25], ["1000.25"]),
        ([1.778279410038923, 3.1622776601683795], ["1.778", "3.162"]),
        ([0.1 + 0.2, 0.4], ["0.3", "0.4"]),
        ([1 / 3, 1 / 3 + 1e-9], ["0.333333333", "0.333333334"]),
        ([-1e-7, 0.0, 1e-7], ["-1e-07", "0", "1e-07"]),
        ([], []),
    ],
)
def test_numbers_are_printed_as_short_as_they_can_be_told_apart(values, texts):
    assert printed(values) == texts


@pytest.mark.parametrize("values", [np.linspace(1000, 1000.5, 10_001), np.geomspace(1, 1.001, 500)])
def test_no_two_values_of_an_axis_are_alike(values):
    assert len(set(printed(values))) == len(values)


def test_even_the_closest_numbers_differ():
    assert printed([1.0, np.nextafter(1.0, 2.0)]) == ["1", "1.0000000000000002"]
    assert digits([1.0, np.nextafter(1.0, 2.0)]) <= MOST


def test_what_is_no_number_does_not_count():
    assert digits([np.nan, np.inf, 5.0]) == 4
