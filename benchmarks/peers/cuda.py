"""The CUDA twin: `twin.cu`, built by NVRTC and launched through cuda.core."""

import ctypes
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.child import BenchError, Missing
from benchmarks.peers import dtype_of, installed
from benchmarks.peers.cpp import REALS
from fic_jax import QUANTITIES, Metrics, Params

SOURCE = Path(__file__).with_name("twin.cu")
PACKAGE = "cuda-core[cu13]"
BLOCK = 128  # threads of a block
PART = 2**20  # scenarios: while a part computes, its neighbours are copied
STREAMS = 3  # one part comes, one computes, one goes


def prepare(batch: Params, dt: float, n_steps: int, threads: int = 2, block: int = BLOCK) -> "Run":
    """Build the twin for blocks of `block` threads, and move the batch to pinned memory.

    `threads` is not used: it is about processors. Raises Missing without a card or NVRTC.
    """
    return Run(batch, dt, n_steps, block)


class Run:
    """A run of the batch: call it for the metrics, from host memory to host memory.

    The next call overwrites the metrics of the last one: they lie in pinned memory.
    """

    def __init__(self, batch: Params, dt: float, n_steps: int, block: int) -> None:
        core, self._driver, device = _cuda()
        columns, where = laid_out(batch)
        self._launch, self._block = core.launch, block
        self._config, self._kernel = core.LaunchConfig, _built(core, device, columns.dtype, block)
        self._streams = [device.create_stream() for _ in range(STREAMS)]
        self.n = max(np.size(getattr(batch, name)) for name in QUANTITIES)
        self._varying = where[where[:, 1] == 1, 0]  # where a column of N numbers starts

        self._columns = self._pinned(columns.size, columns.dtype)
        self._columns[:] = columns
        self._reals = self._pinned(len(REALS) * self.n, columns.dtype)
        self._switches = self._pinned(self.n, np.int32)
        self._finite = self._pinned(self.n, np.uint8)
        host = (self._columns, self._reals, self._switches, self._finite)
        allocated = [device.allocate(a.nbytes, stream=self._streams[0]) for a in (*host, where)]
        self._on_device = dict(zip(map(id, host), allocated, strict=False))
        self._to_device(self._columns, 0, columns.size, self._streams[0])
        layout, copy = allocated[-1], self._driver.cuMemcpyHtoDAsync
        stream = self._streams[0]
        self._done(copy(int(layout.handle), where.ctypes.data, where.nbytes, stream.handle))
        stream.sync()

        real = columns.dtype.type
        self._before = (allocated[0], layout, np.int64(self.n))
        self._after = (real(dt), np.int32(n_steps), *allocated[1:4])

    def __call__(self) -> Metrics:
        """Copy the scenarios to the card, run them, and copy the metrics back."""
        for part, first in enumerate(range(0, self.n, PART)):
            size, stream = min(PART, self.n - first), self._streams[part % STREAMS]
            for start in self._varying:
                self._to_device(self._columns, start + first, size, stream)
            self._run(first, size, stream)
            for m in range(len(REALS)):
                self._to_host(self._reals, m * self.n + first, size, stream)
            self._to_host(self._switches, first, size, stream)
            self._to_host(self._finite, first, size, stream)
        for stream in self._streams:
            stream.sync()
        named = dict(zip(REALS, self._reals.reshape(len(REALS), self.n), strict=True))
        return Metrics(**named, mode_switches=self._switches, finite=self._finite.view(bool))

    def kernel_seconds(self, repeats: int) -> list[float]:
        """Seconds of each of so many launches over all scenarios, by events on the card.

        One more launch comes before them: CUDA loads a kernel at its first launch.
        """
        stream, driver = self._streams[0], self._driver
        self._run(0, self.n, stream)
        begin, end = (self._done(driver.cuEventCreate(0)) for _ in range(2))
        seconds = []
        for _ in range(repeats):
            self._done(driver.cuEventRecord(begin, stream.handle))
            self._run(0, self.n, stream)
            self._done(driver.cuEventRecord(end, stream.handle))
            stream.sync()
            seconds.append(self._done(driver.cuEventElapsedTime(begin, end)) / 1000)
        for event in (begin, end):
            self._done(driver.cuEventDestroy(event))
        return seconds

    def _run(self, first: int, size: int, stream: Any) -> None:
        config = self._config(grid=-(-size // self._block), block=self._block)
        scenarios = np.int64(first), np.int64(first + size)
        self._launch(stream, config, self._kernel, *self._before, *scenarios, *self._after)

    def _to_device(self, a: np.ndarray, first: int, size: int, stream: Any) -> None:
        """Copy so many numbers of a pinned array to its place on the card."""
        host, device = self._addresses(a, first)
        copy = self._driver.cuMemcpyHtoDAsync
        self._done(copy(device, host, size * a.itemsize, stream.handle))

    def _to_host(self, a: np.ndarray, first: int, size: int, stream: Any) -> None:
        host, device = self._addresses(a, first)
        copy = self._driver.cuMemcpyDtoHAsync
        self._done(copy(host, device, size * a.itemsize, stream.handle))

    def _addresses(self, a: np.ndarray, first: int) -> tuple[int, int]:
        offset = int(first) * a.itemsize
        return a.ctypes.data + offset, int(self._on_device[id(a)].handle) + offset

    def _pinned(self, size: int, dtype: Any) -> np.ndarray:
        """An array in memory that the card can read and write without the processor."""
        n_bytes = size * np.dtype(dtype).itemsize
        address = self._done(self._driver.cuMemHostAlloc(n_bytes, 0))
        memory = (ctypes.c_char * n_bytes).from_address(address)
        weakref.finalize(memory, self._driver.cuMemFreeHost, address).atexit = False
        return np.frombuffer(memory, dtype)

    @staticmethod
    def _done(result: tuple[Any, ...]) -> Any:
        """What a function of the driver returns besides its status. Raises BenchError."""
        status, *values = result
        if int(status):
            raise BenchError(f"the CUDA driver says {status.name}")
        return values[0] if values else None


def laid_out(batch: Params) -> tuple[np.ndarray, np.ndarray]:
    """The batch as one array, field after field, and [field, (start, stride)] of each in it.

    Field f of scenario i is the number at start + stride i; a scalar has the stride 0.
    """
    leaves = [np.ravel(np.asarray(getattr(batch, name), dtype_of(batch))) for name in QUANTITIES]
    sizes = np.array([leaf.size for leaf in leaves], np.int64)
    return np.concatenate(leaves), np.stack([np.cumsum(sizes) - sizes, sizes > 1], axis=1)


def _cuda() -> tuple[Any, Any, Any]:
    """cuda.core, the driver and its first device. Raises Missing."""
    core = installed("cuda.core", PACKAGE)
    driver, nvrtc = (installed(f"cuda.bindings.{name}", PACKAGE) for name in ("driver", "nvrtc"))
    needed: dict[str, Callable[[], Any]] = {
        "device": lambda: core.Device().set_current(),
        "NVRTC": nvrtc.nvrtcVersion,
    }
    for name, load in needed.items():
        try:
            load()
        except Exception as error:
            first = (str(error).splitlines() or [type(error).__name__])[0]
            raise Missing(f"no CUDA {name}: {first}") from error
    return core, driver, core.Device()


def _built(core: Any, device: Any, dtype: np.dtype, block: int) -> Any:
    """The kernel for one dtype. No option here makes arithmetic less accurate than IEEE's."""
    major, minor = device.compute_capability
    options = core.ProgramOptions(
        arch=f"sm_{major}{minor}", std="c++17", define_macro=("BLOCK", str(block))
    )
    program = core.Program(SOURCE.read_text(), "c++", options)
    name = "twin_float" if dtype == np.float32 else "twin_double"
    return program.compile("cubin").get_kernel(name)
