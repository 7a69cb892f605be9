"""The compiler from end to end for a CPU: trace, passes in order, LLVM IR, machine code."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from fic_jax.lanes.branches import branch_out
from fic_jax.lanes.cache import cached
from fic_jax.lanes.commoning import common
from fic_jax.lanes.fma import contract
from fic_jax.lanes.graph import Node, Untranslatable
from fic_jax.lanes.objects import Function, compiled, mask_registers, register_bytes, this_processor
from fic_jax.lanes.objects import name as name_of
from fic_jax.lanes.trace import traced
from fic_jax.lanes.vectors import vector_ir

COMPILED = "/fic_jax/compile/lanes"  # event for listeners of JAX: seconds to trace and compile
PART = 4096  # lanes that a core takes at a time: some hundredths of a second at 1,000 iterations
# Registers that a value takes. With two, one instruction works while the other waits: an idle core
# is 1.17 times faster, two busy ones 0.87 times.
REGISTERS = 1


def optimized(
    function: Callable[..., Any],
    types: Sequence[Any],
    uniform: Sequence[bool],
    results: Sequence[Any],
    dtype: np.dtype,
) -> list[Node]:
    """The results of a function, as nodes of its graph after all passes. Raises Untranslatable."""
    if dtype not in (np.float32, np.float64):
        raise Untranslatable(f"floats of type {dtype}")
    graph, roots = traced(function, types, uniform, dtype)
    if len(roots) != len(results):
        raise ValueError(f"`result` has {len(results)} leaves, but the function {len(roots)}.")
    common(graph, roots)
    contract(graph, roots)
    branch_out(graph, roots)
    return roots


class Kernel:
    """A scalar function of given types, compiled for vectors of `lanes`. Threads may share it."""

    def __init__(
        self,
        function: Callable[..., Any],
        types: Sequence[Any],
        uniform: Sequence[bool],
        results: Sequence[Any],
        dtype: np.dtype,
        key: str | None,
    ) -> None:
        began = time.perf_counter()
        self.dtype, self.results = dtype, [np.dtype(one.dtype) for one in results]
        self.lanes = REGISTERS * register_bytes() // dtype.itemsize
        mask_bits = 1 if mask_registers() else 8 * dtype.itemsize
        machine = this_processor()

        def build() -> bytes:
            roots = optimized(function, types, uniform, results, dtype)
            return compiled(machine, vector_ir(roots, dtype, self.lanes, mask_bits))

        signature = f"{[t.dtype.name for t in types]} {list(uniform)} {self.lanes}"
        code = cached(key and f"{key} {signature}", name_of(machine), "o", build)
        self._function = Function(machine, code)
        jax.monitoring.record_event_duration_secs(COMPILED, time.perf_counter() - began)

    def part(self, n: int, threads: int) -> int:
        """Lanes that one of so many threads computes at a time."""
        return min(PART, self._whole(-(-max(n, 1) // threads)))

    def empty(self, n: int) -> list[np.ndarray]:
        """Arrays for the results of n lanes."""
        return [np.empty(n, of) for of in self.results]

    def run(self, leaves: Sequence[np.ndarray], outs: Sequence[np.ndarray]) -> None:
        """Write the results into `outs`, [n] each, for arguments [n] or scalar."""
        n = len(outs[0])
        columns = [leaf for leaf in leaves if leaf.ndim]
        packed = np.empty((len(columns), self._whole(n)), self.dtype)
        for row, column in zip(packed, columns, strict=True):
            row[:n] = _as_bits(column, self.dtype)
            row[n:] = row[n - 1]  # the last vector is whole
        uniforms = [_as_bits(leaf, self.dtype) for leaf in leaves if not leaf.ndim]
        rows = self(packed, np.array(uniforms, self.dtype))[:, :n]
        for row, out in zip(rows, outs, strict=True):
            out[:] = row if out.dtype.kind == "f" else row.view(f"i{self.dtype.itemsize}")

    def __call__(self, columns: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
        """Results [n_results, n] for columns [n_columns, n], n a multiple of `lanes`.

        All in `dtype`. Integers and bools are bits of integers of that width; a bool is 0 if false.
        """
        n = columns.shape[1]
        assert n % self.lanes == 0
        assert all(a.flags.c_contiguous and a.dtype == self.dtype for a in (columns, uniforms))
        results = np.empty((len(self.results), n), self.dtype)
        pointers = (a.ctypes.data for a in (columns, results, uniforms))
        self._function.call(*pointers, n, 0, n)
        return results

    def _whole(self, n: int) -> int:
        """n, rounded up to a whole number of vectors."""
        return -(-n // self.lanes) * self.lanes


def _as_bits(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Floats as they are; integers and bools as bits of integers in the floats' width."""
    if values.dtype.kind == "f":
        return values
    return values.astype(f"i{dtype.itemsize}").view(dtype)
