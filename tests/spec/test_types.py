"""The values of an axis, and the sweeps of the library."""

from decimal import Decimal, localcontext

import numpy as np
import pytest

from sweeps import LIBRARY
from sweeps.plan.grid import Grid
from sweeps.spec.reading import load
from sweeps.spec.types import SpacedRange


def test_an_axis_is_evenly_spaced_on_its_scale():
    logarithmic = SpacedRange(log=(1.0, 1000.0), n=4).values()
    np.testing.assert_allclose(logarithmic, [1.0, 10.0, 100.0, 1000.0])
    linear = SpacedRange(lin=(-1.0, 2.0), n=4).values()
    np.testing.assert_allclose(linear, [-1.0, 0.0, 1.0, 2.0], atol=1e-15)


@pytest.mark.parametrize(
    "axis",
    [
        SpacedRange(log=(1.0, 1000.0), n=4),
        SpacedRange(lin=(16.821, 1.678), n=7),  # a + (b - a) rounds to another number than b
    ],
)
def test_the_ends_of_an_axis_are_exact(axis):
    assert (axis.values()[0], axis.values()[-1]) == axis.ends


@pytest.mark.parametrize(
    ("axis", "decimals"),
    [
        (SpacedRange(lin=(0.0, 1.0), n=11), "0 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8 0.9 1"),
        (SpacedRange(lin=(-0.1, 0.2), n=4), "-0.1 0 0.1 0.2"),
        (SpacedRange(lin=(1e-4, 7e-4), n=7), "1e-4 2e-4 3e-4 4e-4 5e-4 6e-4 7e-4"),
        (SpacedRange(lin=(2e6, 2.3e6), n=4), "2e6 2.1e6 2.2e6 2.3e6"),
        (SpacedRange(log=(1e-3, 1e3), n=7), "1e-3 1e-2 1e-1 1 10 100 1000"),
        (SpacedRange(log=(0.3, 300.0), n=4), "0.3 3 30 300"),
    ],
)
def test_a_short_decimal_is_that_decimal(axis, decimals):
    """So that `.sel(gap=0.3)` finds it and a table shows it."""
    assert axis.values().tolist() == [float(text) for text in decimals.split()]


def test_a_value_is_as_exact_as_float64_allows():
    """On every processor: numpy's float64 `exp` uses its own, less exact one where AVX-512 is."""
    axis = SpacedRange(log=(1.7, 4321.0), n=500)
    with localcontext(prec=40):
        first, last = map(Decimal, axis.ends)
        exact = [float(first * ((last / first).ln() * i / 499).exp()) for i in range(500)]
    np.testing.assert_array_max_ulp(axis.values(), np.array(exact), 1)
    assert (axis.values() == exact).mean() > 0.98


def test_any_part_of_an_axis_has_the_values_of_the_whole():
    axis = SpacedRange(log=(0.3, 1000.0), n=50)
    np.testing.assert_array_equal(axis.values(slice(17, 31)), axis.values()[17:31])


@pytest.mark.parametrize("n", [2, 9, 10, 1001])
@pytest.mark.parametrize("ends", [(-1.0, 1.0), (2.0, -5.0), (-1e-9, 3.0), (1.0, 2.0)])
def test_the_outermost_values_hold_the_smallest_magnitude_of_either_sign(ends, n):
    axis = SpacedRange(lin=ends, n=n)
    values, outermost = axis.values(), axis.outermost
    assert set(outermost) <= set(values)
    assert outermost.min() == values.min() and outermost.max() == values.max()
    for side in (values[values <= 0], values[values >= 0]):
        if side.size:
            assert np.abs(side).min() in np.abs(outermost)


@pytest.mark.parametrize("path", sorted(LIBRARY.glob("*.toml")), ids=lambda p: p.stem)
def test_a_library_sweep_is_valid_and_has_the_name_of_its_file(path):
    assert load(path).name == path.stem


def test_the_atlases_are_as_large_as_they_say():
    assert Grid(load(LIBRARY / "atlas.toml")).cells >= 10_000_000
    assert Grid(load(LIBRARY / "atlas-small.toml")).cells >= 1_000_000
