"""Many scenarios by this processor's vector instructions: a scenario's state stays in registers.

XLA:CPU runs a time step as some forty loops over a block of scenarios, through the first cache.
Here LLVM compiles the same traced function for one vector of scenarios, from its first step to its
last. It jumps over what none of them needs; bits do not depend on who shares a vector.
"""

import ctypes
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import llvmlite.binding as llvm
import numpy as np

from fic_jax.native.branches import branch_out
from fic_jax.native.graph import fuse, traced
from fic_jax.native.vectors import kernel

VECTORS = 2  # registers that make up one value: one instruction's latency hides the other's
PART = 4096  # scenarios that a thread takes at a time: some hundredths of a second at 1,000 steps


def in_vectors(
    run: Callable[..., Any], n_columns: int, result: Any, dtype: np.dtype, threads: int
) -> Callable[[Sequence[np.ndarray], np.ndarray, Any], None]:
    """What writes the results of `run(column, dt)`, of types `result`, for N scenarios to `out`.

    Raises Untranslatable if `run` uses what there is no instruction for here.
    """
    compiled = Kernel(run, n_columns, dtype)

    def fill(leaves: Sequence[np.ndarray], dt: np.ndarray, out: Any) -> None:
        n = len(leaves[0])
        size = min(PART, _whole(-(-n // threads), compiled.lanes))

        def part(start: int) -> None:
            stop = min(start + size, n)
            columns = np.empty((len(leaves), _whole(stop - start, compiled.lanes)), dtype)
            for column, leaf in zip(columns, leaves, strict=True):
                column[: stop - start] = leaf[start:stop]
                column[stop - start :] = leaf[stop - 1]
            found = compiled(columns, dt)
            for row, values in zip(found, jax.tree.leaves(out), strict=True):
                whole = row if values.dtype.kind == "f" else row.view(f"i{dtype.itemsize}")
                values[start:stop] = whole[: stop - start]

        pool = ThreadPoolExecutor(threads)
        try:
            for _ in pool.map(part, range(0, n, size)):
                pass
        finally:
            pool.shutdown(cancel_futures=True)

    return fill


def _whole(n: int, lanes: int) -> int:
    """The scenarios of as many vectors as n need."""
    return -(-n // lanes) * lanes


class Kernel:
    """`run(column, dt)` compiled for vectors of scenarios; threads may share it."""

    def __init__(self, run: Callable[..., Any], n_columns: int, dtype: np.dtype) -> None:
        self.dtype, self.lanes = dtype, lanes(dtype)
        graph, roots = traced(run, n_columns, dtype)
        fuse(graph, roots)
        branch_out(graph, roots)
        self.n_results = len(roots)
        # Every value is in its register already: LLVM's own passes over the text gain nothing, and
        # turn conditions into bits.
        machine = this_processor()
        module = llvm.parse_assembly(kernel(roots, n_columns, dtype, self.lanes))
        module.triple, module.data_layout = machine.triple, str(machine.target_data)
        self._code = llvm.create_mcjit_compiler(module, machine)  # lives as long as the function
        self._code.finalize_object()
        real = ctypes.c_float if dtype == np.float32 else ctypes.c_double
        types = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64]
        self._run = ctypes.CFUNCTYPE(None, *types, real)(self._code.get_function_address("run"))

    def __call__(self, columns: np.ndarray, dt: Any) -> np.ndarray:
        """Results [n_results, n] for columns [n_columns, n], n a multiple of `lanes`.

        All are in the columns' dtype; whole numbers and conditions are bits of integers in it.
        """
        n = columns.shape[1]
        assert n % self.lanes == 0 and columns.flags.c_contiguous and columns.dtype == self.dtype
        found = np.empty((self.n_results, n), self.dtype)
        self._run(columns.ctypes.data, found.ctypes.data, n, 0, n, dt)
        return found


def lanes(dtype: np.dtype) -> int:
    """Scenarios that share the instructions of this processor."""
    features = llvm.get_host_cpu_features()
    register = 64 if features.get("avx512f") else 32 if features.get("avx") else 16
    return VECTORS * register // dtype.itemsize


def this_processor() -> llvm.TargetMachine:
    """What LLVM compiles for."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        jit=True,
    )
