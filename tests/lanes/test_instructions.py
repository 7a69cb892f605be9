"""Instructions: operations against IEEE arithmetic, exp against long double, types of results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax.lanes import objects
from tests.lanes.compiling import DTYPES, ODD, computed


def pairs(dtype):
    """Every pair of special numbers."""
    x, y = np.meshgrid(np.array(ODD, dtype), np.array(ODD, dtype))
    return x.ravel(), y.ravel()


def ones(condition, x):
    return condition.astype(x.dtype)


NUMBERS = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "neg": lambda x, y: -x,
    "abs": lambda x, y: abs(x),
    "sign": lambda x, y: jnp.sign(x),
    "max": jnp.maximum,
    "min": jnp.minimum,
    "floor": lambda x, y: jnp.floor(x),
    "ceil": lambda x, y: jnp.ceil(x),
    "sqrt": lambda x, y: jnp.sqrt(x),
    "square": lambda x, y: jnp.square(x),
    "power": lambda x, y: x**2,
    "cube": lambda x, y: x**3,
    "where": lambda x, y: jnp.where(x < y, x, y),
    "or zero": lambda x, y: jnp.where(x < y, x, 0.0),
    "zero or": lambda x, y: jnp.where(x < y, 0.0, x),
    "or minus zero": lambda x, y: 1.0 / jnp.where(x < y, x, -0.0),  # 1/0 shows the sign of zero
    "minus zero or": lambda x, y: 1.0 / jnp.where(x < y, -0.0, x),
    "or none": lambda x, y: jnp.where(x < y, 2 * (x > 0).astype(jnp.int32), 0).astype(x.dtype),
    "or not": lambda x, y: ones(jnp.where(x < y, x > 0, False), x),
    "le": lambda x, y: ones(x <= y, x),
    "ge": lambda x, y: ones(x >= y, x),
    "eq": lambda x, y: ones(x == y, x),
    "ne": lambda x, y: ones(x != y, x),
    "finite": lambda x, y: jnp.where(jnp.isfinite(x), x, 5.0),
    "and": lambda x, y: ((x > 0) & (y > 0)).astype(x.dtype),
    "or": lambda x, y: ((x > 0) | ~(y > 0)).astype(x.dtype),
    "xor": lambda x, y: ((x > 0) ^ (y > 0)).astype(x.dtype),
    "counted": lambda x, y: ((x > 0).astype(jnp.int32) - (y > 0).astype(jnp.int32)).astype(x.dtype),
    "integers": lambda x, y: jnp.maximum(
        (x > 0).astype(jnp.int32), 3 * (y > 0).astype(jnp.int32)
    ).astype(x.dtype),
    "bools": lambda x, y: ((x > 0) > (y > 0)).astype(x.dtype),
    "no bools": lambda x, y: jnp.minimum(x > 0, y > 0).astype(x.dtype),
    "some": lambda x, y: jnp.where(x.astype(bool), x, 7.0),
    "clipped": lambda x, y: jnp.clip(x, -2.0, 2.0),
}


@pytest.fixture(params=["mask registers", "masks as integers"], autouse=True)
def masks(request, monkeypatch):
    """Both forms of a bool, on any processor."""
    bits = request.param == "mask registers"
    monkeypatch.setattr("fic_jax.lanes.kernel.mask_registers", lambda: bits)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_operations_are_ieee_for_every_pair_of_special_numbers(dtype):
    x, y = pairs(dtype)
    results = computed(lambda x, y: [f(x, y) for f in NUMBERS.values()], x, y)
    for got, (name, f) in zip(results, NUMBERS.items(), strict=True):
        with np.errstate(all="ignore"):
            expected = np.asarray(jax.jit(f)(x, y))
        assert got.dtype == expected.dtype == dtype
        np.testing.assert_array_equal(got, expected, err_msg=name)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_integer_and_bool_results_have_their_types(dtype):
    x = np.array([-2.5, -1.0, 0.0, 1.0, 2.5, 7.0], dtype)
    whole, above = computed(lambda x: (x.astype(jnp.int32), x > 1.0), x)
    assert (whole.dtype, above.dtype) == (np.int32, bool)
    np.testing.assert_array_equal(whole, [-2, -1, 0, 1, 2, 7])
    np.testing.assert_array_equal(above, x > 1.0)
    (unknown,) = computed(lambda x: x.astype(jnp.int32), np.array([np.nan], dtype))
    assert unknown == 0


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_integer_and_bool_arguments(dtype):
    x, n, yes = (
        np.array([0.5, 1.5, 2.5], dtype),
        np.int32([3, -4, 5]),
        np.array([True, False, True]),
    )
    (got,) = computed(
        lambda x, n, yes, k: jnp.where(yes, x + n.astype(dtype), k.astype(dtype)),
        *(x, n, yes, np.int32(7)),
    )
    np.testing.assert_array_equal(got, [3.5, 7.0, 7.5])


@pytest.mark.parametrize(
    ("dtype", "least", "most"), [(DTYPES[0], -87, 88.72), (DTYPES[1], -708, 709.78)]
)
def test_exp_is_right_to_two_units_in_the_last_place(dtype, least, most):
    x = np.random.default_rng(0).uniform(least, most, 100_000).astype(dtype)
    (got,) = computed(jnp.exp, x)
    expected = np.exp(x.astype(np.longdouble))
    error = np.abs(got - expected) / np.spacing(expected.astype(dtype))
    assert error.max() < 2.0
    ends = np.array([0.0, -0.0, -1e4, 1e4, -np.inf, np.inf, np.nan, np.nan], dtype)
    ends.view(f"i{dtype.itemsize}")[-1] += 1  # a NaN with another payload
    (got,) = computed(jnp.exp, ends)
    np.testing.assert_array_equal(got, [1.0, 1.0, 0.0, np.inf, 0.0, np.inf, np.nan, np.nan])


def test_registers_masks_and_fma_follow_from_the_processors_features(monkeypatch):
    for features, width, masks, fused in [
        ("+avx512f,+avx,+fma,", 64, True, True),
        ("-avx512f,+avx,+avx2,+fma,", 32, False, True),
        ("-avx512f,+avx,-fma,", 32, False, False),
        ("+sse2,", 16, False, False),
        ("+neon,", 16, False, True),
    ]:
        monkeypatch.setattr(objects, "features", lambda features=features: features)
        assert objects.register_bytes() == width
        assert (objects.mask_registers(), objects.fused()) == (masks, fused)
