"""Coherent branches: a hint's rare arm moves into a branch, and no bit changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax.lanes import lane_map, where_rare
from fic_jax.lanes.graph import Branch, live
from tests.lanes.compiling import ODD, assert_same, compiled_graph
from tests.lanes.programs import N_COLUMNS, program
from tests.torture import many

PROGRAMS = many(40, 1000)


def unbranched(function, monkeypatch, *columns):
    """Results without the pass."""
    with monkeypatch.context() as patched:
        patched.setattr("fic_jax.lanes.kernel.branch_out", lambda graph, roots: None)
        return lane_map(function)(*columns)


def branches(roots):
    """The live branches, and the operations in each."""
    operations = {}
    for node in live(roots):
        if isinstance(node.scope, Branch):
            operations.setdefault(node.scope, []).append(node.op)
    return operations


def test_the_rare_arm_moves_into_a_branch_and_the_other_arm_stays():
    (branch,) = branches(
        compiled_graph(lambda x, y: where_rare(x > y, lambda: jnp.exp(x), jnp.exp(y)), 2)
    ).items()
    scope, inside = branch
    assert sorted(inside) == ["exp", "select_n"]
    assert scope.condition.op == "gt"
    assert scope.otherwise[0].op == "exp"
    assert scope.otherwise[0].scope is None


def test_a_node_that_others_use_too_stays_outside_the_branch():
    def shared(x, y):
        e = jnp.exp(x)
        return where_rare(x > y, lambda: e * y, y), e

    assert [sorted(ops) for ops in branches(compiled_graph(shared, 2)).values()] == [
        ["mul", "select_n"]
    ]


def test_a_plain_where_makes_no_branch():
    assert not branches(compiled_graph(lambda x, y: jnp.where(x > y, jnp.exp(x), y), 2))


def test_selects_alone_become_a_branch_only_on_a_uniform_condition():
    def tail(x, y):
        def body(i, s):
            return where_rare(i == 3, lambda: (y, x), s)

        return jax.lax.fori_loop(0, 5, body, (x, y))

    assert len(branches(compiled_graph(tail, 2))) == 1
    assert not branches(compiled_graph(lambda x, y: where_rare(x > y, lambda: x, y), 2))


@pytest.mark.parametrize("taken", [True, False])
def test_the_select_that_uses_a_hint_narrows_its_condition(taken):
    """The path predicate is both conditions: a lane that discards the result does not need it."""

    def narrowed(x, y):
        rare = where_rare(x > 0.0, lambda: jnp.exp(x), y)
        return jnp.where(y > 1.0, rare, x) if taken else jnp.where(y > 1.0, x, rare)

    ((scope, _),) = branches(compiled_graph(narrowed, 2)).items()
    assert scope.condition.op == "and"
    assert [a.op for a in scope.condition.args] == ["gt", "gt" if taken else "not"]


def test_a_hint_inside_a_hint_is_a_branch_inside_a_branch():
    def nested(x, y):
        def rare():
            e = jnp.exp(x)
            return where_rare(e > y, lambda: jnp.exp(e), e)

        return where_rare(x > y, rare, y)

    inner, outer = sorted(branches(compiled_graph(nested, 2)), key=lambda b: -b.depth)
    assert inner.outer is outer
    assert outer.outer is None


@pytest.mark.parametrize("transform", [jax.jit, jax.vmap, lambda f: jax.vmap(jax.grad(f))])
def test_without_the_lane_compiler_a_hint_is_a_where(transform):
    """Also its gradient, in either arm."""
    x = jnp.linspace(-1.0, 1.0, 7)
    hinted = transform(lambda x: where_rare(x > 0.0, lambda: jnp.exp(x), 2.0 * x))
    plain = transform(lambda x: jnp.where(x > 0.0, jnp.exp(x), 2.0 * x))
    np.testing.assert_array_equal(hinted(x), plain(x))


@pytest.mark.parametrize("first", range(0, PROGRAMS, 10))
def test_branches_change_no_bit_of_any_program(first, monkeypatch):
    """With two lanes in a vector, so that a vector often skips a branch."""
    monkeypatch.setattr("fic_jax.lanes.kernel.register_bytes", lambda: 16)
    rng = np.random.default_rng(first)
    columns = rng.normal(scale=2.0, size=(N_COLUMNS, 128))
    columns[rng.random(columns.shape) < 0.2] = rng.choice(ODD)
    n_branches = 0
    for seed in range(first, first + 10):
        args = [*columns, 0.25]
        assert_same(lane_map(program(seed))(*args), unbranched(program(seed), monkeypatch, *args))
        n_branches += len(branches(compiled_graph(program(seed), N_COLUMNS + 1)))
    assert n_branches > 0


# Equal arms; a hint whose operand has other users; a condition that no lane meets; a loop between.
SPECIAL = {
    "an arm that is a select": lambda x, y: _arm(jnp.where(y > 1.0, x + 1.0, y), x, y),
    "a carried value that nobody uses": lambda x, y: _unused_carry(
        where_rare(x > 0, lambda: jnp.exp(x), y), x, y
    ),
    "condition in its own arm": lambda x, y: jnp.where(
        y > 1, where_rare(x > 0, lambda: jnp.exp(jnp.where((x > 0) & (y > 1), x, 2 * x)), y), x
    ),
    "negation in its own arm": lambda x, y: jnp.where(
        y > 0, x, where_rare(x > 0, lambda: jnp.exp(jnp.where(~(y > 0), x, 2 * x)), y)
    ),
    "equal arms": lambda x, y: jax.lax.fori_loop(
        0, 2, lambda _, s: where_rare(x > 0, lambda: jnp.exp(s), jnp.exp(s)), y
    ),
    "feeder": lambda x, y: jax.lax.fori_loop(0, 9, _feeder, (x, y)),
    "never": lambda x, y: jax.lax.fori_loop(0, 5, lambda _, s: _nested(s, x > 9.0), (x, y)),
    "through a loop": lambda x, y: jax.lax.fori_loop(0, 3, lambda _, s: _through(s, x > 0, y), x),
}


def _arm(s, x, y):
    return where_rare(x > 0.0, lambda: (s, jnp.exp(x)), (s, y))


def _unused_carry(rare, x, y):
    _, b = jax.lax.fori_loop(0, 2, lambda i, s: (s[0] * 0.5, s[1] + y), (rare, y))
    return jnp.where(b > 0, rare, x)


def _feeder(_, s):
    carried = jnp.where(s[1] > 0, s[1], s[0])
    y = -jnp.abs(carried)
    return carried, where_rare(s[0] > s[1], lambda: jnp.exp(y) * y, s[1]) - y


def _nested(s, condition):
    carried = jnp.where(s[1] > 0, s[1], s[0])
    inner = where_rare(condition, lambda: s[1] - 1, jnp.exp(carried))
    return carried, where_rare(condition, lambda: inner * 2.0, s[1])


def _through(s, condition, start):
    p = where_rare(condition, lambda: jnp.exp(s), start)
    k = jax.lax.fori_loop(0, 5, lambda _, n: n * 0.5 + p, start)
    return where_rare(condition, lambda: jnp.exp(k), s)


@pytest.mark.parametrize("name", SPECIAL)
def test_branches_change_no_bit_of_special_programs(name, monkeypatch):
    columns = np.linspace(-3.0, 3.0, 48), np.linspace(0.5, -1.5, 48)
    assert_same(lane_map(SPECIAL[name])(*columns), unbranched(SPECIAL[name], monkeypatch, *columns))
