"""`lane_map`, the public function: it compiles once for each signature and shares the columns."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

if TYPE_CHECKING:
    from fic_jax.lanes.gpu import ThreadKernel
    from fic_jax.lanes.kernel import Kernel


def usable_cores() -> frozenset[int]:
    """The numbers of the cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux
    return frozenset(affinity(0) if affinity else range(os.cpu_count() or 1))


def cores() -> int:
    """How many cores this process may use."""
    return len(usable_cores())


class LaneMap:
    """A function of scalars, mapped over columns (see `lane_map`)."""

    def __init__(
        self,
        function: Callable[..., Any],
        threads: int | None,
        gpus: Sequence[int],
        key: str | None,
        result: Any,
        likeness: Callable[..., np.ndarray] | None,
    ) -> None:
        self._function, self._key, self._result = function, key, result
        self._likeness, self._gpus = likeness, tuple(gpus)
        self._threads = threads or cores()
        self._compiled: dict[Any, tuple[Kernel | ThreadKernel, Any]] = {}

    def __call__(self, *args: Any) -> Any:
        """Results with leaves [N], for arguments with leaves [N] or scalar."""
        leaves, tree, dtype = _arguments(args)
        kernel, result = self._kernel(leaves, tree, dtype)
        n = _length(leaves)
        outs = kernel.empty(1 if n is None else n)
        self._compute(kernel, leaves, tree, outs)
        out = jax.tree.unflatten(jax.tree.structure(result), outs)
        return out if n is not None else jax.tree.map(lambda leaf: leaf[0], out)

    def inside_jit(self, *args: Any) -> Any:
        """The same for JAX arrays in a function that `jax.jit` traces; they stay on the device."""
        leaves, tree = jax.tree.flatten(args)
        leaves, dtype = [jnp.asarray(leaf) for leaf in leaves], _float_type(leaves)
        kernel, result = self._kernel(leaves, tree, dtype)
        n = _length(leaves)
        varying = [leaf.ndim > 0 for leaf in leaves]

        def call(context: Any, results: Any, *columns: Any) -> None:
            if self._gpus:
                n_lanes = 1 if n is None else n
                kernel.launch_from(context.stream, columns, varying, results, n_lanes)  # type: ignore[union-attr]
            else:
                outs = [np.asarray(one).reshape(-1) for one in results]
                self._compute(kernel, [np.asarray(one) for one in columns], tree, outs)

        shape = () if n is None else (n,)
        types = [jax.ShapeDtypeStruct(shape, leaf.dtype) for leaf in jax.tree.leaves(result)]
        outs = buffer_callback(call, types)(*leaves)
        return jax.tree.unflatten(jax.tree.structure(result), outs)

    def _compute(
        self,
        kernel: "Kernel | ThreadKernel",
        leaves: Sequence[np.ndarray],
        tree: Any,
        outs: Sequence[np.ndarray],
    ) -> None:
        """Write the results into `outs`, [N] each, part by part in several threads."""
        mapped, n = any(leaf.ndim for leaf in leaves), len(outs[0])
        size = kernel.part(n, self._threads)

        def part(start: int) -> None:
            stop = min(start + size, n)
            those = [leaf[start:stop] if leaf.ndim else leaf for leaf in leaves]
            parts = [out[start:stop] for out in outs]
            if not (self._likeness and mapped):
                kernel.run(those, parts)
                return
            order = self._likeness(*jax.tree.unflatten(tree, those))
            rows = [np.empty_like(one) for one in parts]
            kernel.run([leaf[order] if leaf.ndim else leaf for leaf in those], rows)
            for one, row in zip(parts, rows, strict=True):
                one[order] = row

        if size >= n > 0 and not self._gpus:  # whose work needs a thread where it is current
            part(0)
            return
        pool = ThreadPoolExecutor(self._threads)
        try:
            for _ in pool.map(part, range(0, n, size)):
                pass
        finally:
            pool.shutdown(cancel_futures=True)

    def prepare(self, *args: Any) -> None:
        """Compile for arguments like these, and run nothing."""
        self._kernel(*_arguments(args))

    def _kernel(
        self, leaves: Sequence[np.ndarray], tree: Any, dtype: np.dtype
    ) -> "tuple[Kernel | ThreadKernel, Any]":
        """The kernel for arguments like these, and the types of its results."""
        types = [jax.ShapeDtypeStruct((), leaf.dtype) for leaf in leaves]
        uniform = [leaf.ndim == 0 and not self._gpus for leaf in leaves]
        signature = (tree, dtype, *(t.dtype for t in types), *uniform)
        if signature not in self._compiled:

            def flat(*leaves: Any) -> Any:
                return self._function(*jax.tree.unflatten(tree, leaves))

            result = self._result
            if result is None:
                result = jax.eval_shape(flat, *types)
            key = self._key and f"{self._key} {tree}"
            compiled = self._target()
            kernel = compiled(flat, types, uniform, jax.tree.leaves(result), dtype, key)
            self._compiled[signature] = kernel, result
        return self._compiled[signature]

    def _target(self) -> "Callable[..., Kernel | ThreadKernel]":
        """What compiles; late, since llvmlite or cuda.core may be missing, and take a while."""
        if self._gpus:
            from fic_jax.lanes.gpu import ThreadKernel

            return partial(ThreadKernel, self._gpus)
        from fic_jax.lanes.kernel import Kernel

        return Kernel


def lane_map(
    function: Callable[..., Any],
    *,
    threads: int | None = None,
    gpus: Sequence[int] = (),
    key: str | None = None,
    result: Any = None,
    likeness: Callable[..., np.ndarray] | None = None,
) -> LaneMap:
    """`jax.jit(jax.vmap(function))` on this CPU's vector registers and cores, or on NVIDIA GPUs.

    For functions of scalars that spend their time in a loop:

        def oscillator(k, c):                 # scalars (or pytrees of them) in and out
            def step(_, s):
                x, v = s
                return x + 0.01 * v, v - 0.01 * (k * x + c * v)
            return jax.lax.fori_loop(0, 1000, step, (1.0 + 0.0 * k, 0.0 * k))

        x, v = lane_map(oscillator)(np.linspace(1, 9, 10**6), 0.1)

    Arguments are NumPy or JAX arrays [N], or scalars, which are the same for all N; results are
    NumPy arrays [N]. All floats have one type, float32 or float64 (that of the arguments, as JAX
    sees it); integers fit into 32 bits. A lane's result depends on its own arguments alone, bit for
    bit: not on N, on the neighbours, on `threads` (default: all cores) or on the registers' width.
    `gpus` are the CUDA ordinals of the GPUs that compute, instead of the CPU; their bits are those
    of a CPU with fused multiply-adds.

    `key` names the function for the compile cache (`jax_compilation_cache_dir`): functions, and
    versions of one function, need different keys. Cached code is neither traced nor compiled.
    `result` is the structure and types of the results; with it they need no trace either.
    `likeness`, called with a part of the arguments, returns an order (indices) that puts lanes side
    by side which take the same rare branches: they then share a vector. It changes no bit.

    Raises Untranslatable if the function uses more than elementwise arithmetic, `exp`, `where` and
    loops of fixed length; ImportError without llvmlite; ValueError for arguments of other shapes.
    """
    return LaneMap(function, threads, gpus, key, result, likeness)


def _arguments(args: Any) -> tuple[list[np.ndarray], Any, np.dtype]:
    """Leaves as arrays with JAX's types, their structure, and the type of the floats."""
    leaves, tree = jax.tree.flatten(args)
    dtype = _float_type(leaves)
    kinds = [jnp.result_type(leaf) for leaf in leaves]
    arrays = [
        np.asarray(leaf, dtype if kind.kind == "f" else kind)
        for leaf, kind in zip(leaves, kinds, strict=True)
    ]
    return arrays, tree, dtype


def _float_type(leaves: Sequence[Any]) -> np.dtype:
    """The type of the floats among the arguments, or JAX's."""
    kinds = [jnp.result_type(leaf) for leaf in leaves]
    floats = [leaf for leaf, kind in zip(leaves, kinds, strict=True) if kind.kind == "f"]
    return np.dtype(jnp.result_type(*floats) if floats else jnp.result_type(float))


def _length(leaves: Sequence[Any]) -> int | None:
    """N of leaves that are scalars or [N]; None if all are scalars. Raises ValueError."""
    shapes = {leaf.shape for leaf in leaves if leaf.ndim}
    if len(shapes) > 1 or any(len(shape) > 1 for shape in shapes):
        raise ValueError(f"`lane_map` takes scalars and [N] arrays of one length, not {shapes}.")
    return shapes.pop()[0] if shapes else None
