"""Predictive commoning: an iteration reuses only values that the last iteration has computed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax.lanes.commoning import common
from fic_jax.lanes.graph import live
from tests.lanes.compiling import assert_same, computed, graph_of, loop_of, scopes_of


def f(x, k):
    return 1.9 * jnp.exp(-k * x * x)


def iterations(start, combine=jnp.maximum, carry=jnp.copy):
    """A loop whose iteration begins with f(carried), which the last one carried as its third."""

    def body(_, s):
        x = combine(0.5 * s[0], f(s[0], s[1]))
        return x, carry(s[1]), f(x, s[1])

    return lambda x, k: jax.lax.fori_loop(0, 4, body, (x, k, start(x, k)))


def with_and_without(function, monkeypatch):
    x, k = np.linspace(-2.0, 2.0, 40), np.linspace(0.1, 0.5, 40)
    reused = computed(function, x, k)
    monkeypatch.setattr("fic_jax.lanes.kernel.common", lambda graph, roots: None)
    return reused, computed(function, x, k)


# Without the copy JAX takes the constant out of the carried values.
@pytest.mark.parametrize("carry", [jnp.copy, lambda k: k], ids=["carried", "closed over"])
@pytest.mark.parametrize(
    ("combine", "units"),
    # A carried product is rounded; without the pass, FMA contraction saves this rounding. Four
    # iterations differ by one rounding each, and each at most doubles the error so far: 2^4 eps.
    [(jnp.maximum, 0), (jnp.add, 16)],
    ids=["bit for bit", "to rounding"],
)
def test_an_iteration_reuses_a_value_of_the_last_one(combine, units, carry, monkeypatch):
    function = iterations(f, combine, carry)
    graph, roots = graph_of(function, 2)
    loop = loop_of(live(roots))
    carried = any(phi is out for phi, out in zip(loop.phis, loop.outs, strict=True))
    assert carried == (carry is jnp.copy)
    common(graph, roots)
    assert scopes_of(roots, "exp").count(loop) == 1
    reused, anew = with_and_without(function, monkeypatch)
    np.testing.assert_allclose(reused, anew, rtol=units * np.finfo(float).eps, atol=0.0)


@pytest.mark.parametrize(
    "start",
    [
        lambda x, k: 3.0 * jnp.exp(-k * x * x),
        lambda x, k: f(k, x),
        lambda x, k: f(x, x),
        lambda x, k: x,
    ],
    ids=["another constant", "swapped", "another operand", "no operation"],
)
def test_a_loop_that_starts_with_another_value_reuses_nothing(start, monkeypatch):
    graph, roots = graph_of(iterations(start), 2)
    common(graph, roots)
    assert scopes_of(roots, "exp").count(loop_of(live(roots))) == 2
    assert_same(*with_and_without(iterations(start), monkeypatch))
