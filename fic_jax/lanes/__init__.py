"""Many scenarios by this processor's vector instructions: a scenario's state stays in registers.

XLA:CPU runs a time step as some forty loops over a block of scenarios, through the first cache.
Here LLVM compiles the same traced function for one vector of scenarios, from its first step to its
last. It jumps over what none of them needs; bits do not depend on who shares a vector.
"""

import ctypes
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from fic_jax.lanes.branches import branch_out
from fic_jax.lanes.code import Function, kept, register_bytes, this_processor
from fic_jax.lanes.graph import Untranslatable
from fic_jax.lanes.rounding import fuse
from fic_jax.lanes.tracing import traced
from fic_jax.lanes.turns import recall
from fic_jax.lanes.vectors import kernel

PART = 4096  # scenarios that a thread takes at a time: some hundredths of a second at 1,000 steps
COMPILED = "/fic_jax/compile/native"  # the event that tells listeners of JAX how long it took

Scenario = Callable[[list[jax.Array], jax.Array], Any]  # quantities, dt -> results


def in_vectors(
    run: Scenario,
    n_columns: int,
    result: Any,
    dtype: np.dtype,
    *,
    registers: int,
    threads: int,
    identity: str,
) -> Callable[[Sequence[np.ndarray], np.ndarray, Any], None]:
    """What writes the results of `run(column, dt)`, of types `result`, for N scenarios to `out`.

    A value takes that many `registers`; `identity` names `run` among all that these sources can
    make. Raises Untranslatable if it uses what there is no instruction for here.
    """
    compiled = Kernel(run, n_columns, len(jax.tree.leaves(result)), dtype, registers, identity)

    def fill(leaves: Sequence[np.ndarray], dt: np.ndarray, out: Any) -> None:
        n = len(leaves[0])
        size = min(PART, _whole(-(-max(n, 1) // threads), compiled.lanes))

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
    """`run(column, dt)` compiled for vectors of `lanes` scenarios; threads may share it."""

    def __init__(
        self,
        run: Scenario,
        n_columns: int,
        n_results: int,
        dtype: np.dtype,
        registers: int,
        identity: str,
    ) -> None:
        began = time.perf_counter()
        if dtype not in (np.float32, np.float64):
            raise Untranslatable(f"numbers of type {dtype}")
        self.dtype, self.n_results = dtype, n_results
        self.lanes = registers * register_bytes() // dtype.itemsize

        def text() -> str:
            graph, roots = traced(run, n_columns, dtype)
            recall(graph, roots)
            fuse(graph, roots)
            branch_out(graph, roots)
            return kernel(roots, n_columns, dtype, self.lanes)

        machine = this_processor()
        code = kept(f"{identity} {n_columns} {dtype} {self.lanes}", machine, text)
        real = ctypes.c_float if dtype == np.float32 else ctypes.c_double
        self._function = Function(machine, code, real)
        jax.monitoring.record_event_duration_secs(COMPILED, time.perf_counter() - began)

    def __call__(self, columns: np.ndarray, dt: Any) -> np.ndarray:
        """Results [n_results, n] for columns [n_columns, n], n a multiple of `lanes`.

        All are in the columns' dtype; whole numbers and conditions are bits of integers in it.
        """
        n = columns.shape[1]
        assert n % self.lanes == 0 and columns.flags.c_contiguous and columns.dtype == self.dtype
        found = np.empty((self.n_results, n), self.dtype)
        self._function.call(columns.ctypes.data, found.ctypes.data, n, 0, n, dt)
        return found
