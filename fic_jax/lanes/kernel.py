"""The compiler from end to end: trace, passes in order, LLVM IR, machine code."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from fic_jax.lanes.branches import branch_out
from fic_jax.lanes.commoning import common
from fic_jax.lanes.emit import llvm_ir
from fic_jax.lanes.fma import contract
from fic_jax.lanes.graph import Untranslatable
from fic_jax.lanes.objects import Function, cached, mask_registers, register_bytes, this_processor
from fic_jax.lanes.trace import traced

COMPILED = "/fic_jax/compile/lanes"  # event for listeners of JAX: seconds to trace and compile
# Registers that a value takes. With two, one instruction works while the other waits: an idle core
# is 1.17 times faster, two busy ones 0.87 times.
REGISTERS = 1


class Kernel:
    """A scalar function of given types, compiled for vectors of `lanes`. Threads may share it."""

    def __init__(
        self,
        function: Callable[..., Any],
        types: Sequence[Any],
        uniform: Sequence[bool],
        n_results: int,
        dtype: np.dtype,
        key: str | None,
    ) -> None:
        began = time.perf_counter()
        if dtype not in (np.float32, np.float64):
            raise Untranslatable(f"floats of type {dtype}")
        self.dtype, self.n_results = dtype, n_results
        self.lanes = REGISTERS * register_bytes() // dtype.itemsize
        mask_bits = 1 if mask_registers() else 8 * dtype.itemsize

        def emit() -> str:
            graph, roots = traced(function, types, uniform, dtype)
            if len(roots) != n_results:
                raise ValueError(f"`result` has {n_results} leaves, but the function {len(roots)}.")
            common(graph, roots)
            contract(graph, roots)
            branch_out(graph, roots)
            return llvm_ir(roots, dtype, self.lanes, mask_bits)

        machine = this_processor()
        signature = f"{[t.dtype.name for t in types]} {list(uniform)} {self.lanes}"
        code = cached(key and f"{key} {signature}", machine, emit)
        self._function = Function(machine, code)
        jax.monitoring.record_event_duration_secs(COMPILED, time.perf_counter() - began)

    def __call__(self, columns: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
        """Results [n_results, n] for columns [n_columns, n], n a multiple of `lanes`.

        All in `dtype`. Integers and bools are bits of integers of that width; a bool is 0 if false.
        """
        n = columns.shape[1]
        assert n % self.lanes == 0
        assert all(a.flags.c_contiguous and a.dtype == self.dtype for a in (columns, uniforms))
        results = np.empty((self.n_results, n), self.dtype)
        pointers = (a.ctypes.data for a in (columns, results, uniforms))
        self._function.call(*pointers, n, 0, n)
        return results
