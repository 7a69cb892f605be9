"""Kernels on NVIDIA GPUs: cuda.core loads PTX, launches it and copies columns and results.

Several threads of the host call a kernel, each with a stream of its own, so that one part is copied
while others are computed.
"""

import ctypes
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import accumulate, cycle
from typing import Any

import jax
import numpy as np

from fic_jax.lanes.cache import cached
from fic_jax.lanes.kernel import COMPILED, optimized
from fic_jax.lanes.threads import KERNEL, THREADS, ptx, thread_ir

# Lanes that a stream computes at a time. An H100 holds 100,000 of the default model; a part of
# 2^18 takes 3 ms at 1,000 iterations, and its copies hide behind the other streams' work.
LEAST, MOST = 2**15, 2**18
NEWEST = (9, 0)  # compute capability whose PTX all newer GPUs take, too
ALIGNED = 256  # bytes


class ThreadKernel:
    """A scalar function of given types, compiled for threads. Threads of the host may share it."""

    def __init__(
        self,
        function: Callable[..., Any],
        types: Sequence[Any],
        results: Sequence[Any],
        dtype: np.dtype,
        key: str | None,
        gpus: Sequence[int],
    ) -> None:
        from cuda.core import Device, ObjectCode

        began = time.perf_counter()
        self.types, self.results = ([np.dtype(one.dtype) for one in s] for s in (types, results))
        self._gpus = cycle(gpus)
        oldest = min(NEWEST, *(tuple(Device(gpu).compute_capability) for gpu in gpus))

        def build() -> bytes:
            roots = optimized(function, types, [False] * len(types), results, dtype)
            text = thread_ir(roots, dtype, self.types, self.results)
            return ptx(text, oldest).encode()

        code = cached(key and f"{key} {[t.name for t in self.types]}", f"{oldest}", "ptx", build)
        Device(gpus[0]).set_current()
        self._code = ObjectCode.from_ptx(code)  # holds the kernel's memory
        self._kernel = self._code.get_kernel(KERNEL)
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

    @contextmanager
    def computed(self, leaves: Sequence[np.ndarray], n: int) -> Iterator[list[np.ndarray]]:
        """Results [n] for arguments [n] or scalar. They are overwritten after the `with`."""
        varying = [leaf.strides not in ((), (0,)) for leaf in leaves]
        lengths = [n if one else 1 for one in varying] + [n] * len(self.results)
        types = [*self.types, *self.results]
        sizes = [length * of.itemsize for length, of in zip(lengths, types, strict=True)]
        starts = list(accumulate((-(-size // ALIGNED) * ALIGNED for size in sizes), initial=0))
        n_columns, split = len(leaves), starts[len(leaves)]
        with _staging(next(self._gpus), starts[-1]) as staging:
            rows = [
                staging.host[start : start + size].view(of)
                for start, size, of in zip(starts, sizes, types, strict=False)
            ]
            for row, leaf in zip(rows, leaves, strict=False):
                row[:] = leaf[: len(row)] if leaf.ndim else leaf
            staging.to_device(0, split)
            places = [staging.address + start for start in starts[:-1]]
            self.launch(staging.stream, places[:n_columns], varying, places[n_columns:], n)
            staging.to_host(split, starts[-1])
            staging.stream.sync()
            yield rows[n_columns:]


class Staging:
    """A stream of one GPU, memory there, and as much page-locked memory of the host."""

    def __init__(self, gpu: int, size: int) -> None:
        from cuda.core import Device, LegacyPinnedMemoryResource

        self.size, device = size, Device(gpu)
        self.stream = device.create_stream()
        self._device = device.allocate(size, stream=self.stream)
        self._host = LegacyPinnedMemoryResource().allocate(size)
        self.address = int(self._device.handle)
        self.host = np.ctypeslib.as_array(
            (ctypes.c_uint8 * size).from_address(int(self._host.handle))
        )

    def to_device(self, start: int, stop: int) -> None:
        """Copy these bytes to the GPU."""
        source, target = self._part(self._host, start, stop), self._part(self._device, start, stop)
        target.copy_from(source, stream=self.stream)

    def to_host(self, start: int, stop: int) -> None:
        """Copy these bytes from the GPU."""
        source, target = self._part(self._device, start, stop), self._part(self._host, start, stop)
        target.copy_from(source, stream=self.stream)

    @staticmethod
    def _part(buffer: Any, start: int, stop: int) -> Any:
        from cuda.core import Buffer

        return Buffer.from_handle(int(buffer.handle) + start, stop - start)


_idle: dict[int, deque[Staging]] = {}  # of each GPU


@contextmanager
def _staging(gpu: int, size: int) -> Iterator[Staging]:
    """Staging of at least so many bytes, idle or new, for the calling thread."""
    from cuda.core import Device

    Device(gpu).set_current()
    idle = _idle.setdefault(gpu, deque())
    try:
        staging = idle.pop()
    except IndexError:
        staging = Staging(gpu, size)
    if staging.size < size:
        staging = Staging(gpu, size)
    try:
        yield staging
    finally:
        idle.append(staging)
