"""`while_loop`: lanes that have finished keep their numbers while others go on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax.lanes import lane_map, where_rare
from tests.lanes.compiling import assert_same, computed

N = 203
X = np.linspace(0.5, 40.0, N)
Y = np.cos(np.arange(N))


def halvings(x, y):
    """Halves x until it is below 1: 0 to 6 iterations."""
    return jax.lax.while_loop(
        lambda s: s[0] >= 1.0,
        lambda s: (0.5 * s[0], s[1] + s[0] * y, s[2] + np.int32(1)),
        (x, y, np.int32(0)),
    )


def in_a_loop(x, y):
    """Three while loops, one after the other, with other conditions for each."""

    def body(i, s):
        total, level = s
        level = jax.lax.while_loop(
            lambda a: a > y + i.astype(a.dtype), lambda a: 0.5 * a - 1.0, level
        )
        return total + level, level + 3.0

    return jax.lax.fori_loop(np.int32(0), np.int32(3), body, (y, x))


def around_a_loop(x, y):
    """A loop of fixed length inside."""

    def body(s):
        return jax.lax.fori_loop(
            np.int32(0), np.int32(3), lambda _, t: (t[0] * 0.75, t[1] + y * t[0]), s
        )

    return jax.lax.while_loop(lambda s: s[0] > 2.0, body, (x, y))


def in_a_while_loop(x, y):
    """The inner loop ends at other times in each lane and in each iteration."""

    def body(s):
        outer, total = s
        total = jax.lax.while_loop(lambda t: t < outer, lambda t: 1.5 * t + 1.0, total)
        return 0.5 * outer, 0.125 * total

    return jax.lax.while_loop(lambda s: s[0] > 1.0, body, (x, jnp.abs(y)))


def with_a_rare_branch(x, y):
    """Branches in the body, in the condition, and around the loop."""

    def body(s):
        a, b = s
        b = where_rare(a > 20.0, lambda: jnp.exp(-a) + b * jnp.exp(-b * b), b)
        return 0.5 * a, b + 0.25

    def goes_on(s):
        return where_rare(s[1] > 1.5, lambda: jnp.exp(-s[1]) * s[0], s[0]) > 0.75

    def loop():
        return jax.lax.while_loop(goes_on, body, (x, y))

    return where_rare(y > 0.5, loop, (x, y))


def uniform(x, y):
    """A condition that is the same in all lanes."""
    return jax.lax.while_loop(
        lambda s: s[0] < np.int32(5), lambda s: (s[0] + np.int32(1), s[1] * x), (np.int32(0), y)
    )


def unused(x, y):
    """A carried value that nobody reads, and one that the condition alone reads."""
    a, *_ = jax.lax.while_loop(
        lambda s: s[1] > 1.0, lambda s: (s[0] + y, 0.5 * s[1], s[2] * y), (x, x, y)
    )
    return a


def swapped(x, y):
    """Values that only change places."""
    return jax.lax.while_loop(lambda s: s[2] > 0.5, lambda s: (s[1], s[0], s[2] * 0.5), (x, y, x))[
        :2
    ]


def reused(x, y):
    """The value at the end of an iteration is computed anew at the start of the next one."""

    def f(a):
        return 1.9 * jnp.exp(-0.3 * a * a)

    def body(s):
        a = jnp.maximum(0.5 * s[0], f(s[0]))
        return a, s[1] + 1.0, f(a)

    return jax.lax.while_loop(lambda s: s[1] < x, body, (y, 0.0 * y, f(y)))


PROGRAMS = {
    f.__name__: f
    for f in (
        halvings,
        in_a_loop,
        around_a_loop,
        in_a_while_loop,
        with_a_rare_branch,
        uniform,
        unused,
        swapped,
        reused,
    )
}
in_all_programs = pytest.mark.parametrize("name", PROGRAMS)


@in_all_programs
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_while_loop_computes_what_jax_computes(name, dtype):
    """Counts exactly; the rest to the rounding that FMAs save in at most 50 iterations."""
    x, y = X.astype(dtype), Y.astype(dtype)
    got = computed(PROGRAMS[name], x, y)
    expected = jax.tree.leaves(jax.jit(jax.vmap(PROGRAMS[name]))(x, y))
    for mine, theirs in zip(got, expected, strict=True):
        assert mine.dtype == theirs.dtype
        tolerance = 50.0 * np.finfo(dtype).eps
        np.testing.assert_allclose(mine, theirs, rtol=tolerance, atol=tolerance)


def test_lanes_finish_after_their_own_number_of_iterations():
    count = computed(halvings, X, Y)[2]
    np.testing.assert_array_equal(count, np.maximum(np.floor(np.log2(X)) + 1.0, 0.0))
    assert count.min() == 0
    assert count.max() == 6


@in_all_programs
def test_a_lane_alone_has_the_bits_of_the_lane_among_others(name):
    mapped = lane_map(PROGRAMS[name])
    whole = mapped(X, Y)
    for i in (0, 3, 100, N - 1):
        alone = mapped(X[i : i + 1], Y[i : i + 1])
        assert_same(alone, jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], whole))


@in_all_programs
def test_passes_and_registers_change_no_bit(name, monkeypatch):
    """Without branches; with one, two or four vectors side by side; with vectors of two lanes."""
    expected = lane_map(PROGRAMS[name])(X, Y)
    for registers in (1, 4):
        monkeypatch.setattr("fic_jax.lanes.kernel.REGISTERS", registers)
        assert_same(lane_map(PROGRAMS[name])(X, Y), expected)
    monkeypatch.setattr("fic_jax.lanes.kernel.register_bytes", lambda: 16)
    assert_same(lane_map(PROGRAMS[name])(X, Y), expected)
    monkeypatch.setattr("fic_jax.lanes.kernel.branch_out", lambda graph, roots: None)
    assert_same(lane_map(PROGRAMS[name])(X, Y), expected)


@in_all_programs
def test_no_iteration_leaves_the_start(name):
    """Conditions that no lane meets: results are those of a vmapped loop, which are the starts."""
    x, y = np.zeros(9), np.linspace(6.0, 8.0, 9)
    if name in ("uniform", "in_a_loop"):
        return  # their conditions hold for these values too
    got = computed(PROGRAMS[name], x, y)
    expected = jax.tree.leaves(jax.vmap(PROGRAMS[name])(x, y))
    for mine, theirs in zip(got, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_lane_that_becomes_nan_ends_its_loop():
    """A comparison with NaN is false: the lane stops, the others go on."""

    def grows(x):
        return jax.lax.while_loop(lambda s: s < 1e6, lambda s: s * s + x, x)

    x = np.array([2.0, np.nan, 3.0, np.inf, 1.5])
    (got,) = computed(grows, x)
    np.testing.assert_array_equal(got, jax.vmap(grows)(x))


@pytest.mark.parametrize("part", [8, 4096])
@pytest.mark.parametrize("order", ["sorted", "reversed", "shuffled"])
def test_likeness_changes_no_bit(order, part, monkeypatch):
    monkeypatch.setattr("fic_jax.lanes.kernel.PART", part)
    calls = []

    def likeness(x, y):
        calls.append((np.shape(x), np.shape(y)))
        orders = {
            "sorted": np.argsort(x),
            "reversed": np.arange(len(x))[::-1],
            "shuffled": np.random.default_rng(len(x)).permutation(len(x)),
        }
        return orders[order]

    for program in (halvings, with_a_rare_branch):
        expected = lane_map(program)(X, 0.75)
        assert_same(lane_map(program, likeness=likeness)(X, 0.75), expected)
    assert calls
    assert all(of_y == () for _, of_y in calls)
    assert sum(of_x[0] for of_x, _ in calls) == 2 * N


def test_likeness_of_scalars_alone_is_not_used():
    def refuse(*_):
        raise AssertionError

    assert lane_map(lambda x, y: x + y, likeness=refuse)(1.0, 2.0) == 3.0
