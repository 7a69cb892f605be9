"""FMA contraction: a product with one user is not rounded before the sum, any other is."""

import numpy as np
import pytest

from fic_jax.lanes.objects import fused
from tests.lanes.compiling import compiled_graph, computed, scopes_of

X, Y = np.float32([1.0 + 2.0**-20]), np.float32([1.0 - 2.0**-20])
EXACT, ROUNDED = -(2.0**-40), 0.0  # of x y - 1


def test_a_product_and_its_only_sum_are_rounded_once():
    (got,) = computed(lambda x, y: x * y - 1.0, X, Y)
    assert got == (EXACT if fused() else ROUNDED)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: (x * y - 1.0, x * y),
        lambda x, y: (x * y - 1.0, x * y + 1.0),
    ],
    ids=["a result", "a second sum"],
)
def test_a_product_with_two_users_is_rounded(function):
    assert computed(function, X, Y)[0] == ROUNDED


@pytest.mark.parametrize(
    ("function", "signs"),
    [
        (lambda x, y, z: x * y + z, "+ +"),
        (lambda x, y, z: z + x * y, "+ +"),
        (lambda x, y, z: x * y - z, "+ -"),
        (lambda x, y, z: z - x * y, "- +"),
        (lambda x, y, z: z - x**2, "- +"),
    ],
)
def test_signs_and_values_of_each_form(function, signs):
    (root,) = compiled_graph(function, 3)
    assert (root.op, root.value) == ("fma", signs)
    columns = np.float64([3.0, -1.5]), np.float64([0.25, 8.0]), np.float64([5.0, -7.0])
    np.testing.assert_array_equal(computed(function, *columns)[0], function(*columns))


def test_the_product_that_is_computed_last_is_fused():
    (root,) = compiled_graph(lambda x, y, z: x * y + (x + y + z) * z, 3)
    assert root.args[2].op == "mul"
    assert scopes_of([root], "fma") == [None]
