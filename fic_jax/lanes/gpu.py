"""Kernels on NVIDIA GPUs: cuda.core loads PTX, launches it and copies columns and results.

Several threads of the host call a kernel, each with a stream of its own: while one part is
computed, others are copied. Results are copied once, to where the caller's arrays lie.
"""

import ctypes
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import accumulate, cycle
from typing import Any

import jax
import numpy as np

from fic_jax.lanes.cache import cached
from fic_jax.lanes.kernel import COMPILED, optimized
from fic_jax.lanes.threads import KERNEL, THREADS, ptx, thread_ir

# Lanes that a stream computes at a time. An H100 holds 100,000 of the default model; a part of
# 2^18 takes 3 ms at 1,000 iterations, and its copies hide behind the other streams' work.
LEAST, MOST = 2**17, 2**18
NEWEST = (9, 0)  # compute capability whose PTX all newer GPUs take, too
ALIGNED = 256  # bytes
UNUSED = 2**30  # bytes of page-locked memory that may wait for arrays


class ThreadKernel:
    """A scalar function of given types, compiled for threads. Threads of the host may share it."""

    def __init__(
        self,
        gpus: Sequence[int],
        function: Callable[..., Any],
        types: Sequence[Any],
        uniform: Sequence[bool],
        results: Sequence[Any],
        dtype: np.dtype,
        key: str | None,
    ) -> None:
        from cuda.core import Device, ObjectCode

        began = time.perf_counter()
        self.types, self.results = ([np.dtype(one.dtype) for one in s] for s in (types, results))
        self._first, self._gpus = gpus[0], cycle(gpus)
        oldest = min(NEWEST, *(tuple(Device(gpu).compute_capability) for gpu in gpus))

        def build() -> bytes:
            roots = optimized(function, types, uniform, results, dtype)
            text = thread_ir(roots, dtype, self.types, self.results)
            return ptx(text, oldest).encode()

        code = cached(key and f"{key} {[t.name for t in self.types]}", f"{oldest}", "ptx", build)

        def load() -> tuple[Any, Any]:
            module = ObjectCode.from_ptx(code)
            return module, module.get_kernel(KERNEL)

        self._module, self._kernel = _where_current(self._first, load)
        jax.monitoring.record_event_duration_secs(COMPILED, time.perf_counter() - began)

    def part(self, n: int, threads: int) -> int:
        """Lanes that one of so many threads of the host computes at a time."""
        return min(MOST, max(LEAST, -(-n // threads)))

    def launch(
        self,
        stream: Any,
        columns: Sequence[int],
        varying: Sequence[bool],
        results: Sequence[int],
        n: int,
    ) -> None:
        """Compute n lanes on a stream, from and to these addresses on its GPU.

        A column has n numbers where it is varying, else one.
        """
        from cuda.core import LaunchConfig, launch

        if n == 0:
            return
        config = LaunchConfig(grid=-(-n // THREADS), block=THREADS)
        strides = [np.int32(one) for one in varying]
        launch(stream, config, self._kernel, *columns, *results, *strides, np.int64(n))

    def launch_from(
        self, stream: int, columns: Sequence[Any], varying: Sequence[bool], results: Any, n: int
    ) -> None:
        """Compute n lanes on JAX's stream, from and to its buffers."""
        from cuda.core import Stream

        own = Stream.from_handle(stream)
        own.device.set_current()
        read, written = (
            [one.__cuda_array_interface__["data"][0] for one in buffers]
            for buffers in (columns, results)
        )
        self.launch(own, read, varying, written, n)

    def empty(self, n: int) -> list[np.ndarray]:
        """Arrays for the results of n lanes, each in page-locked memory of its own."""

        def allocated() -> list[np.ndarray]:
            with suppress(Exception):  # without such memory copies are slower
                return [page_locked(n * of.itemsize)[: n * of.itemsize].view(of) for of in types]
            return [np.empty(n, of) for of in types]

        types = self.results
        return _where_current(self._first, allocated)

    def run(self, leaves: Sequence[np.ndarray], outs: Sequence[np.ndarray]) -> None:
        """Write the results into `outs`, [n] each, for arguments [n] or scalar."""
        with self.loaded(leaves, len(outs[0])) as (stage, launch, results):
            launch()
            for address, out in zip(results, outs, strict=True):
                stage.copy(out.ctypes.data, address, out.nbytes)
            stage.stream.sync()

    @contextmanager
    def loaded(
        self, leaves: Sequence[np.ndarray], n: int
    ) -> "Iterator[tuple[Stage, Callable[[], None], list[int]]]":
        """Put arguments, [n] or scalar, on a GPU until the end of the `with`.

        Yields the stage, a function that launches the kernel, and the addresses of the results.
        """
        varying = [leaf.strides not in ((), (0,)) for leaf in leaves]
        lengths = [n if varies else 1 for varies in varying] + [n] * len(self.results)
        places, size = laid_out([*self.types, *self.results], lengths)
        read, written = places[: len(leaves)], places[len(leaves) :]
        split = read[-1].stop if read else 0
        with _stage(next(self._gpus), split, size) as stage:
            for place, leaf, dtype in zip(read, leaves, self.types, strict=True):
                column = stage.host[place].view(dtype)
                column[:] = leaf[: len(column)] if leaf.ndim else leaf
            stage.copy(stage.address, stage.host.ctypes.data, split)
            columns, results = (
                [stage.address + place.start for place in places] for places in (read, written)
            )
            yield stage, lambda: self.launch(stage.stream, columns, varying, results, n), results


def laid_out(types: Sequence[np.dtype], lengths: Sequence[int]) -> tuple[list[slice], int]:
    """The bytes of each of some arrays that lie in one block of memory, and the block's size."""
    sizes = [of.itemsize * length for of, length in zip(types, lengths, strict=True)]
    starts = list(accumulate((-(-size // ALIGNED) * ALIGNED for size in sizes), initial=0))
    return [slice(i, i + size) for i, size in zip(starts, sizes, strict=False)], starts[-1]


class Stage:
    """A stream of one GPU, memory there, and page-locked memory of the host."""

    def __init__(self, gpu: int, host: int, device: int) -> None:
        from cuda.core import Device

        self.stream = Device(gpu).create_stream()
        self.host, self.size = page_locked(host), device
        self._device = Device(gpu).allocate(max(device, 1), stream=self.stream)
        self.address = int(self._device.handle)

    def copy(self, target: int, source: int, size: int) -> None:
        """Copy bytes between host and GPU: page-locked memory, while the host does other things."""
        from cuda.core import Buffer

        if size:
            to, of = (Buffer.from_handle(address, size) for address in (target, source))
            to.copy_from(of, stream=self.stream)


_idle: dict[int, deque[Stage]] = {}  # of each GPU
_unused: deque[Any] = deque()  # page-locked memory that no array needs


@contextmanager
def _stage(gpu: int, host: int, device: int) -> Iterator[Stage]:
    """A stage with at least so many bytes, for the calling thread alone."""
    from cuda.core import Device

    Device(gpu).set_current()
    idle = _idle.setdefault(gpu, deque())
    try:
        stage = idle.pop()
    except IndexError:
        stage = Stage(gpu, host, device)
    if len(stage.host) < host or stage.size < device:
        stage = Stage(gpu, host, device)
    try:
        yield stage
    except BaseException:
        with suppress(Exception):
            stage.stream.sync()  # before others get the memory that its copies write to
        raise
    idle.append(stage)


def _where_current(gpu: int, function: Callable[[], Any]) -> Any:
    """Call a function in a thread where a GPU is current: in the caller's, another one may be."""
    from cuda.core import Device

    def call() -> Any:
        Device(gpu).set_current()
        return function()

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(call).result()


def page_locked(size: int) -> np.ndarray:
    """So many bytes of the host, or more, that a GPU can copy: at 55 GB/s, pageable memory at 14.

    To lock pages takes long: memory is used again after the last array in it is deleted.
    """
    from cuda.core import LegacyPinnedMemoryResource

    size = max(size, ALIGNED)
    buffer = _fitting(size) or LegacyPinnedMemoryResource().allocate(size)
    memory = (ctypes.c_uint8 * buffer.size).from_address(int(buffer.handle))
    weakref.finalize(memory, _unused.append, buffer).atexit = False
    return np.ctypeslib.as_array(memory)


def _fitting(size: int) -> Any:
    """Unused memory of so many bytes, to twice as many; what is unused beyond UNUSED is freed."""
    found, kept = None, 0
    for _ in range(len(_unused)):
        try:
            buffer = _unused.popleft()
        except IndexError:  # another thread was faster
            break
        if found is None and size <= buffer.size <= 2 * size:
            found = buffer
        elif kept + buffer.size <= UNUSED:
            kept += buffer.size
            _unused.append(buffer)
        else:
            buffer.close()
    return found
