"""A copy has cells of the store: all of them, or every k-th, never others."""

import base64
import zlib
from types import SimpleNamespace

import numpy as np
import pytest

from sweeps.explore.cells import REASONS
from sweeps.explore.stored import Stored
from sweeps.plan.grid import Grid
from sweeps.share.coarse import (
    DOUBT,
    KEPT_BITS,
    LEAST_VALUES,
    MANTISSA,
    copied,
    count,
    encoded,
    rounded,
    strides,
)
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store.opening import dataset

ALL = 10_000_000  # bytes


@pytest.fixture
def source(joint):
    return Stored(joint)


def decoded(text, dtype, shape):
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    return planes.reshape(np.dtype(dtype).itemsize, -1).T.copy().view(dtype).reshape(shape)


def test_four_digits_stay():
    values = np.geomspace(1e-30, 1e30, 5_001).astype(np.float32)
    found = rounded(values, KEPT_BITS)
    assert (np.abs(found - values) <= 2.0**-14 * values).all()
    assert np.unique(found.view(np.uint32) & ((1 << (MANTISSA - KEPT_BITS)) - 1)) == 0
    np.testing.assert_array_equal(rounded(-values, KEPT_BITS), -found)
    np.testing.assert_array_equal(rounded(values, MANTISSA), values)


def test_what_is_no_number_stays_and_no_number_becomes_infinite():
    values = np.array([np.inf, -np.inf, np.nan, 0.0, np.finfo(np.float32).max], np.float32)
    np.testing.assert_array_equal(rounded(values, KEPT_BITS), values)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_an_encoded_array_comes_back(dtype):
    array = (np.arange(60) * 3.7).astype(dtype).reshape(3, 4, 5)
    np.testing.assert_array_equal(decoded(encoded(array), dtype, array.shape), array)


def planned(text):
    return SimpleNamespace(grid=Grid(parse(text, "sweep.toml")))


PLAN = """
name = "plan"
[model]
contact = ["hard_stop", "welded"]
[axes]
K0 = { log = [1.0, 1000.0], n = 128 }
Kenv = { log = [1.0, 1000.0], n = 40 }
Td = [1.0, 5.0, 12.0]
"""


def test_the_longest_axis_is_thinned_first():
    source = planned(PLAN)
    assert set(strides(source, source.grid.cells).values()) == {1}
    assert strides(source, source.grid.cells // 2) == {"contact": 1, "K0": 3, "Kenv": 1, "Td": 1}
    found = strides(source, 2 * 20 * 20 * 3)
    sides = {dim: count(source.grid.dims[dim], k) for dim, k in found.items()}
    assert sides["contact"] == 2
    assert sides["Td"] == 3
    assert 0.5 < sides["K0"] / sides["Kenv"] < 2
    assert sides["K0"] * sides["Kenv"] <= 20 * 20


def test_no_axis_becomes_too_short():
    source = planned(PLAN)
    found = strides(source, 0)
    sides = {dim: count(source.grid.dims[dim], k) for dim, k in found.items()}
    assert sides == {"contact": 2, "K0": LEAST_VALUES, "Kenv": LEAST_VALUES, "Td": 3}


@pytest.mark.parametrize("n", [1, 2, 5, 9, 128])
@pytest.mark.parametrize("stride", [1, 2, 3, 7, 200])
def test_the_count_of_a_stride(n, stride):
    assert count(n, stride) == len({*range(0, n, stride), n - 1})


def test_a_store_that_fits_is_copied_whole_and_exactly(source, joint):
    copy = copied(source, ["nmse", "convergence_time"], [], ALL)
    assert (copy.bits, copy.cells, set(copy.strides.values())) == (MANTISSA, 2 * 9 * 8 * 3, {1})
    data = dataset(joint).sortby("Kenv")  # the store has it descending
    for name, metric in copy.metrics.items():
        np.testing.assert_array_equal(metric.values, data[name])
        np.testing.assert_array_equal(metric.codes >= DOUBT, data[f"{name}_trusted"] == 1)
        infinite = (metric.codes % DOUBT) == REASONS.index("infinite")
        np.testing.assert_array_equal(infinite, np.isinf(data[name]))
        shape = metric.values.shape
        found = decoded(copy.encoded[f"values-{name}"], np.float32, shape)
        np.testing.assert_array_equal(found, metric.values)
    np.testing.assert_array_equal(copy.axes["Kenv"].values, data["Kenv"])
    np.testing.assert_array_equal(copy.converged, np.isfinite(data["convergence_time"]))


def test_a_smaller_copy_has_ends_pins_and_the_numbers_of_the_store(source, joint):
    pin = (1, 3, 6, 0)
    copy = copied(source, ["nmse", "peak_torque"], [pin], 1_000)
    assert copy.size <= 1_000
    assert copy.bits == KEPT_BITS
    assert max(copy.strides.values()) > 1
    data = dataset(joint)
    for dim, index in zip(data["nmse"].dims, pin, strict=True):
        assert {0, index, data.sizes[dim] - 1} <= set(copy.kept[dim])
    cells = data.isel({dim: list(kept) for dim, kept in copy.kept.items()})
    for name, metric in copy.metrics.items():
        np.testing.assert_array_equal(metric.values, cells[name])
        shape = metric.values.shape
        found = decoded(copy.encoded[f"values-{name}"], np.float32, shape)
        np.testing.assert_allclose(found, cells[name], rtol=2.0**-14)


def test_a_copy_that_does_not_fit_is_one_line(source):
    with pytest.raises(SweepError, match=r"smallest copy needs .* raise --size") as error:
        copied(source, ["nmse"], [], 100)
    assert "\n" not in str(error.value)
