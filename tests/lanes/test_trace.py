"""Tracing: loops, uniform values, and functions that cannot be translated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax.lanes import Untranslatable
from tests.lanes.compiling import computed

LOOPS = {
    "swapped": lambda x, y, dt: jax.lax.fori_loop(0, 5, lambda i, s: (s[1], s[0]), (x, y)),
    "the same": lambda x, y, dt: jax.lax.fori_loop(0, 5, lambda i, s: s, (x, y)),
    # a carried value that is uniform at first
    "uniform": lambda x, y, dt: jax.lax.fori_loop(
        0, 4, lambda i, s: (s[1], s[1] + x, dt), 3 * (dt,)
    ),
    "counted": lambda x, y, dt: jax.lax.fori_loop(
        0,
        7,
        lambda i, s: (s[0] + i.astype(float) * x, jnp.where(i == 3, y, s[1])),
        (x, y),
    ),
    "nested": lambda x, y, dt: jax.lax.fori_loop(
        0,
        3,
        lambda i, s: jax.lax.fori_loop(0, 2, lambda j, t: (t[0] + y, t[1] * 0.5), s),
        (x, y),
    ),
    "two": lambda x, y, dt: jax.lax.fori_loop(
        0,
        3,
        lambda i, s: (s[0] * 2.0, s[1] + s[0]),
        jax.lax.fori_loop(0, 2, lambda i, s: (s[0] + dt, s[1] - dt), (x, y)),
    ),
    # values that are carried unchanged in some iterations
    "carried": lambda x, y, dt: jax.lax.fori_loop(
        0,
        9,
        lambda i, s: (
            jnp.where(s[1] > 0.0, s[1], s[0]),
            jnp.exp(-jnp.abs(jnp.where(s[1] > 0.0, s[1], s[0]))) - s[1],
        ),
        (x, y),
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_loops_compute_what_jax_computes(name):
    """Exact where nothing is rounded, else to the one rounding that an FMA saves."""
    x, y = np.linspace(-3.0, 4.0, 40), np.linspace(2.0, -2.0, 40)
    got = computed(LOOPS[name], x, y, 0.25)
    expected = jax.vmap(LOOPS[name], in_axes=(0, 0, None))(x, y, 0.25)
    for mine, theirs in zip(got, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-14, atol=1e-15)


def test_a_scan_without_arrays_is_a_loop():
    def halved(x):
        return jax.lax.scan(lambda s, _: (0.5 * s, None), x, length=3)[0]

    np.testing.assert_array_equal(computed(halved, np.float64([8.0, 16.0]))[0], [1.0, 2.0])


def test_a_scan_without_a_carry_leaves_nothing():
    def unchanged(x):
        jax.lax.scan(lambda carry, _: (carry, None), (), length=3)
        jax.lax.scan(lambda _, __: ((), (x + 1.0, None)[1]), (), length=2)
        return x

    np.testing.assert_array_equal(computed(unchanged, np.ones(3))[0], 1.0)


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (jnp.sin, "the operation sin"),
        (lambda x: x**5, "the power 5"),
        (lambda x: jnp.sign((x > 0).astype(jnp.int32)), "the operation sign on"),
        (lambda x: jax.lax.select_n((x > 0).astype(jnp.int32), x, x), "select_n"),
        (lambda x: x.astype(jnp.int8), "int8 among"),
        (lambda x: jax.lax.scan(lambda s, _: (s, s), x, length=3)[0], "over arrays"),
        (lambda x: jnp.stack([x, x]).sum(), "the operation|array"),
        (
            lambda x: jax.lax.while_loop(lambda s: s[0] < 1, lambda s: s + 1, jnp.stack([x, x])),
            "a while loop over arrays",
        ),
        (lambda x: x.astype(jnp.float64), "float64 among float32"),
        (lambda x: (x, np.uint8(3)), "uint8 among"),
        (lambda x: (x, np.float64(0.1)), "float64 among float32"),
        (lambda x: jnp.arange(3, dtype=x.dtype)[1] * x, "operation|array|among"),
        (lambda x: jnp.where(x > 0, 2**40, 1), "the integer 1099511627776"),
    ],
)
def test_the_error_names_the_untranslatable_operation(function, named):
    with pytest.raises(Untranslatable, match=named):
        computed(function, np.ones(8, np.float32))


def test_a_gradient_has_a_translation():
    """Its sums are `add_any`."""

    def gradient(x):
        return jax.grad(lambda x: x * jnp.exp(x) + x * x)(x)

    x = np.linspace(-1.0, 1.0, 9)
    np.testing.assert_allclose(computed(gradient, x)[0], np.exp(x) * (1 + x) + 2 * x, rtol=1e-14)


def test_floats_of_other_types_have_no_translation():
    with pytest.raises(Untranslatable, match="floats of type float16"):
        computed(lambda x: x + x, np.ones(3, np.float16))
