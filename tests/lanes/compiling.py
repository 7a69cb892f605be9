"""The compiler's steps one by one, for tests."""

import jax
import numpy as np

from fic_jax.lanes import lane_map
from fic_jax.lanes.branches import branch_out
from fic_jax.lanes.commoning import common
from fic_jax.lanes.fma import contract
from fic_jax.lanes.graph import Loop, live
from fic_jax.lanes.trace import traced
from fic_jax.lanes.vectors import vector_ir

DTYPES = [np.dtype(np.float32), np.dtype(np.float64)]
ODD = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 3.0, 7.25, 1e-30, -1e-30, 1e30, np.inf, -np.inf, np.nan]


def computed(function, *args):
    """The leaves of the results of `function`, through the compiler."""
    return jax.tree.leaves(lane_map(function)(*args))


def graph_of(function, n_columns, dtype=DTYPES[1]):
    """Graph and roots of a function of columns."""
    scalar = jax.ShapeDtypeStruct((), dtype)
    return traced(function, [scalar] * n_columns, [False] * n_columns, dtype)


def compiled_graph(function, n_columns, dtype=DTYPES[1]):
    """The roots after all passes."""
    graph, roots = graph_of(function, n_columns, dtype)
    common(graph, roots)
    contract(graph, roots)
    branch_out(graph, roots)
    return roots


def text(function, n_columns, lanes, mask_bits, dtype=DTYPES[1]):
    """The LLVM IR of a function of columns."""
    return vector_ir(compiled_graph(function, n_columns, dtype), dtype, lanes, mask_bits)


def loop_of(nodes):
    """The only loop."""
    (loop,) = {n.of for n in nodes if isinstance(n.of, Loop)}
    return loop


def scopes_of(roots, op):
    """Scopes of the live nodes with an operation."""
    return [n.scope for n in live(roots) if n.op == op]


def assert_same(a, b):
    """The same bits, the sign of zero included, except for the bits of a NaN."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(np.signbit(x[x == 0]), np.signbit(y[x == 0]))
