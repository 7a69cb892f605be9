"""`lane_map` computes what `jit(vmap(function))` computes, for any number of threads and parts."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax.lanes import lane_map
from tests.lanes.compiling import assert_same


def oscillator(k, c):
    """The docstring's example."""

    def step(_, s):
        x, v = s
        return x + 0.01 * v, v - 0.01 * (k * x + c * v)

    return jax.lax.fori_loop(0, 1000, step, (1.0 + 0.0 * k, 0.0 * k))


K = np.linspace(1.0, 9.0, 1003)


def test_lane_map_equals_vmap():
    got = lane_map(oscillator)(K, 0.1)
    expected = jax.jit(jax.vmap(oscillator, in_axes=(0, None)))(K, 0.1)
    for mine, theirs in zip(got, expected, strict=True):
        assert isinstance(mine, np.ndarray)
        np.testing.assert_allclose(mine, theirs, rtol=1e-11, atol=1e-12)


def test_pytrees_of_arguments_and_results():
    got = lane_map(lambda p, s: {"sum": p["a"] + s, "both": (p["b"], p["a"] > 1)})(
        {"a": np.float32([1, 2]), "b": jnp.float32([3, 4])}, np.float32(0.5)
    )
    np.testing.assert_array_equal(got["sum"], [1.5, 2.5])
    np.testing.assert_array_equal(got["both"][0], [3, 4])
    np.testing.assert_array_equal(got["both"][1], [False, True])


@pytest.mark.parametrize("n", [0, 1, 17])
def test_any_length(n):
    assert lane_map(jnp.exp)(np.zeros(n)).tolist() == [1.0] * n


def test_scalars_alone_give_scalars():
    assert lane_map(lambda x, y: x + y)(1.0, 2.0) == 3.0


def test_a_scalar_argument_gives_the_bits_of_a_constant_column():
    mapped = lane_map(oscillator)
    assert_same(mapped(K, 0.1), mapped(K, np.full_like(K, 0.1)))


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("part", [8, 100])
@pytest.mark.parametrize("registers", [1, 4])
def test_threads_parts_and_registers_change_no_bit(threads, part, registers, monkeypatch):
    expected = lane_map(oscillator)(K, 0.1)
    monkeypatch.setattr("fic_jax.lanes.kernel.PART", part)
    monkeypatch.setattr("fic_jax.lanes.kernel.REGISTERS", registers)
    assert_same(lane_map(oscillator, threads=threads)(K, 0.1), expected)


def test_a_lane_alone_has_the_bits_of_the_lane_among_others():
    mapped = lane_map(oscillator)
    whole = mapped(K, 0.1)
    for i in (0, 1, 500, 1002):
        assert_same(mapped(K[i : i + 1], 0.1), [leaf[i : i + 1] for leaf in whole])


def test_a_signature_is_compiled_once():
    traces = []

    def function(x):
        traces.append(x.dtype)
        return 2.0 * x

    mapped = lane_map(function, result=jax.ShapeDtypeStruct((), np.float64))
    mapped.prepare(np.ones(3))
    assert traces == [np.float64]
    mapped(np.ones(5))
    assert len(traces) == 1


@pytest.mark.parametrize("shapes", [[(2,), (3,)], [(2, 2)]])
def test_arrays_of_other_shapes_are_refused(shapes):
    with pytest.raises(ValueError, match=r"scalars and \[N\] arrays of one length"):
        lane_map(lambda *x: x[0])(*map(np.ones, shapes))


def test_a_result_with_other_leaves_is_refused():
    mapped = lane_map(lambda x: (x, x), result=jax.ShapeDtypeStruct((), np.float64))
    with pytest.raises(ValueError, match="`result` has 1 leaves, but the function 2"):
        mapped(np.ones(3))


def test_an_error_in_a_part_reaches_the_caller(monkeypatch):
    mapped = lane_map(jnp.exp, threads=2)
    mapped.prepare(np.ones(2))
    monkeypatch.setattr("fic_jax.lanes.kernel.Kernel.__call__", _fail)
    with pytest.raises(MemoryError):
        mapped(np.ones(100))


def _fail(*_):
    raise MemoryError


def test_importing_needs_no_llvmlite_and_nothing_else_of_the_project():
    code = """
import sys
sys.modules["llvmlite"] = None
import fic_jax.lanes
from fic_jax.lanes import lane_map
import numpy
try:
    lane_map(abs)(numpy.ones(2))
except ImportError as error:
    assert "llvmlite" in str(error)
else:
    raise AssertionError
"""
    subprocess.run([sys.executable, "-c", code], check=True)
