"""A stand-in for `cuda.core`: GPUs whose memory is the host's and whose kernels are interpreted.

It has what the lane compiler uses of cuda.core 1.2, with its signatures and its refusals. A stream
works when it is waited for, not before; a kernel may only touch memory of its own GPU.
"""

import ctypes
import sys
import threading
from collections import deque, namedtuple
from types import ModuleType

import numpy as np

from tests.lanes.ptx_machine import Program

ComputeCapability = namedtuple("ComputeCapability", "major minor")
WIDTHS = {np.int32: "u32", np.int64: "u64"}


class Card:
    """The GPUs of a machine, by their compute capabilities; a module for `import cuda.core`."""

    def __init__(self, *capabilities, driver=None):
        self.capabilities, self.driver = capabilities, driver
        self.memory = [{} for _ in capabilities]  # of each GPU: address -> bytes
        self.current = threading.local()
        self.launches, self.programs = [], []
        self.locked = 0  # bytes, ever

    def module(self):
        """The modules `cuda` and `cuda.core`."""
        core = ModuleType("cuda.core")
        for name, value in {
            "Device": lambda device_id: Device(self, device_id),
            "ObjectCode": type("ObjectCode", (ObjectCode,), {"card": self}),
            "Stream": type("Stream", (Stream,), {"card": self}),
            "LegacyPinnedMemoryResource": lambda: LegacyPinnedMemoryResource(self),
            "LaunchConfig": LaunchConfig,
            "EventOptions": EventOptions,
            "Buffer": Buffer,
            "launch": launch,
        }.items():
            setattr(core, name, value)
        core.Device.get_all_devices = lambda: tuple(
            Device(self, i) for i in range(len(self.capabilities))
        )
        package = ModuleType("cuda")
        package.core, package.__path__ = core, []
        return {"cuda": package, "cuda.core": core}

    def check(self, gpu, address, size):
        """Refuse an address outside the memory of a GPU."""
        for start, data in self.memory[gpu].items():
            if start <= address and address + size <= start + len(data):
                return
        raise MemoryError(f"an illegal address on GPU {gpu}")


def install(monkeypatch, *capabilities, **options):
    """Put GPUs of these compute capabilities into this machine for a test."""
    card = Card(*capabilities, **options)
    for name, module in card.module().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr("fic_jax.lanes.gpu._idle", {})
    monkeypatch.setattr("fic_jax.lanes.gpu._unused", deque())
    return card


class Device:
    def __init__(self, card, device_id):
        if card.driver is not None:
            raise card.driver
        if not 0 <= device_id < len(card.capabilities):
            raise ValueError(f"device_id must be within [0, {len(card.capabilities)})")
        self.card, self.device_id = card, device_id

    @property
    def compute_capability(self):
        return ComputeCapability(*self.card.capabilities[self.device_id])

    def set_current(self):
        self.card.current.gpu = self.device_id

    def _expect_current(self):
        """As CUDA wants it, in each thread of the host."""
        if getattr(self.card.current, "gpu", None) != self.device_id:
            raise RuntimeError(f"GPU {self.device_id} is not current in this thread")

    def create_stream(self):
        self._expect_current()
        return Stream.of(self)

    def create_event(self, options=None):
        self._expect_current()
        return Event(options)

    def allocate(self, size, *, stream):
        self._expect_current()
        assert isinstance(stream, Stream) and stream.device.device_id == self.device_id
        data = np.full(size, 0xAA, np.uint8)  # no one may rely on zeros
        self.card.memory[self.device_id][data.ctypes.data] = data
        return Buffer.of(data.ctypes.data, size)


class Stream:
    card = None
    handles = {}  # noqa: RUF012  of streams that JAX would own

    def __init__(self):
        raise RuntimeError("Stream objects cannot be instantiated directly")

    @classmethod
    def of(cls, device):
        stream = object.__new__(Stream)
        stream.device, stream.waiting = device, []
        return stream

    @classmethod
    def from_handle(cls, handle):
        if type(handle) is not int:
            raise TypeError("an integer is required")
        return cls.handles[handle]

    def record(self, event=None):
        assert isinstance(event, Event)
        event.stream = self
        self.waiting.append(event.happen)
        return event

    def sync(self):
        waiting, self.waiting = self.waiting, []
        for work in waiting:
            work()


class EventOptions:
    def __init__(self, *, timing_enabled=False):
        self.timing_enabled = timing_enabled


class Event:
    """Its time is the number of things that its stream has done."""

    done = 0

    def __init__(self, options):
        self.timed, self.time = bool(options and options.timing_enabled), None

    def happen(self):
        Event.done += 1
        self.time = Event.done

    def sync(self):
        self.stream.sync()

    def __sub__(self, earlier):
        """Milliseconds."""
        if not (self.timed and earlier.timed):
            raise RuntimeError("Both Events must be created with timing enabled")
        return 250.0 * (self.time - earlier.time)


class Handle:
    """An address that says so only to `int`, as CUDA's handles do."""

    def __init__(self, address):
        self._address = address

    def __int__(self):
        return self._address


class Buffer:
    def __init__(self):
        raise RuntimeError("Buffer objects cannot be instantiated directly")

    @classmethod
    def of(cls, address, size, data=None):
        buffer = object.__new__(Buffer)
        buffer.handle, buffer.size, buffer._data = Handle(address), size, data
        return buffer

    @classmethod
    def from_handle(cls, ptr, size, mr=None, owner=None, *, stream=None):
        assert type(ptr) is int and (mr, owner, stream) == (None, None, None)
        return cls.of(ptr, size)

    def close(self):
        self._data = None

    def copy_from(self, src, *, stream):
        assert isinstance(src, Buffer) and isinstance(stream, Stream)
        if src.size != self.size:
            raise ValueError(f"buffer sizes mismatch: {src.size} and {self.size}")
        places = int(self.handle), int(src.handle), self.size
        stream.waiting.append(lambda: ctypes.memmove(*places))


class LegacyPinnedMemoryResource:
    def __init__(self, card):
        self.card = card

    def allocate(self, size, *, stream=None):
        if getattr(self.card.current, "gpu", None) is None:
            raise RuntimeError("CUDA_ERROR_INVALID_CONTEXT")
        self.card.locked += size
        data = np.full(size, 0x55, np.uint8)
        return Buffer.of(data.ctypes.data, size, data)


class LaunchConfig:
    def __init__(self, grid=None, cluster=None, block=None):
        for name, value in {"grid": grid, "block": block}.items():
            if type(value) is not int or value < 1:
                raise ValueError(f"LaunchConfig.{name} must be an int, not {value!r}")
        self.grid, self.block = grid, block


class ObjectCode:
    card = None

    def __init__(self):
        raise RuntimeError("ObjectCode objects cannot be instantiated directly")

    @classmethod
    def from_ptx(cls, module, *, name=""):
        if not isinstance(module, bytes):  # a str would be a path
            raise TypeError(f"expected bytes, not {type(module)}")
        code = object.__new__(cls)
        code.program = Program(module.decode())
        cls.card.programs.append(code.program)
        return code

    def get_kernel(self, name):
        assert name == "run"
        return Kernel(self.card, self.program)


class Kernel:
    def __init__(self, card, program):
        self.card, self.program = card, program


def launch(stream, config, kernel, *kernel_args):
    """Queue the kernel. A Python int is an address; other numbers have NumPy's types."""
    types = [("u64", True) if type(a) is int else (WIDTHS[type(a)], False) for a in kernel_args]
    assert types == kernel.program.parameters
    assert isinstance(stream, Stream) and config.block <= kernel.program.threads
    gpu, card = stream.device.device_id, kernel.card
    major, minor = card.capabilities[gpu]
    assert int(kernel.program.target.removeprefix("sm_")) <= 10 * major + minor
    card.launches.append((gpu, config.grid))
    arguments = [int(a) for a in kernel_args]

    def work():
        for block in range(config.grid):
            for thread in range(config.block):
                kernel.program.run(
                    arguments,
                    {"%ctaid.x": block, "%ntid.x": config.block, "%tid.x": thread},
                    lambda address, size: card.check(gpu, address, size),
                )

    stream.waiting.append(work)
