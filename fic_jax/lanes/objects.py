"""From LLVM IR to machine code in this process, with a cache beside JAX's compiled programs."""

import contextlib
import ctypes
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import jax
import llvmlite
import llvmlite.binding as llvm

from fic_jax.lanes.sources import digest


def this_processor() -> llvm.TargetMachine:
    """The machine that LLVM compiles for."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features(), opt=3, jit=True
    )


def features() -> str:
    """The instruction sets of this processor, in LLVM's words."""
    return str(llvm.get_host_cpu_features().flatten())


def register_bytes() -> int:
    """Width of this processor's vector registers."""
    return 64 if "+avx512f," in features() else 32 if "+avx," in features() else 16


def mask_registers() -> bool:
    """Whether this processor keeps one bit a lane in registers of their own."""
    return "+avx512f," in features()


def fused() -> bool:
    """Whether this processor has a fused multiply-add: its results differ in the last bits."""
    return "+fma," in features() or "+neon" in features() or "+fma4," in features()


class Function:
    """The function `run` of an object file, and the memory that holds it."""

    def __init__(self, machine: llvm.TargetMachine, code: bytes) -> None:
        empty = llvm.parse_assembly("")
        empty.triple, empty.data_layout = machine.triple, str(machine.target_data)
        self._memory = llvm.create_mcjit_compiler(empty, machine)  # as long as the function lives
        self._memory.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._memory.finalize_object()
        types = [*3 * [ctypes.c_void_p], *3 * [ctypes.c_int64]]
        self.call = ctypes.CFUNCTYPE(None, *types)(self._memory.get_function_address("run"))


def compiled(machine: llvm.TargetMachine, text: str) -> bytes:
    """The object file of a module.

    LLVM's optimisation passes do not run: the IR is already in SSA form, and they would turn masks
    into single bits.
    """
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    return bytes(machine.emit_object(module))


def cached(key: str | None, machine: llvm.TargetMachine, emit: Callable[[], str]) -> bytes:
    """The object file of the IR that `emit` returns, from the compile cache if it has it.

    `key` identifies this IR among all that the package emits. Without a key or without a cache
    (`jax_compilation_cache_dir`) it reads and writes no file.
    """
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    sources = digest(Path(__file__).parent)
    if not (key and folder and sources):
        return compiled(machine, emit())
    versions = f"jax {jax.__version__} llvmlite {llvmlite.__version__} {llvm.llvm_version_info}"
    processor = f"{machine.triple} {llvm.get_host_cpu_name()} {features()}"
    name = hashlib.sha256(f"{key}\n{sources}\n{versions}\n{processor}".encode()).hexdigest()
    path = Path(folder) / f"lanes-{name[:32]}.o"
    try:
        content = path.read_bytes()
        checksum, code = content[:32], content[32:]
        if hashlib.sha256(code).digest() == checksum:
            return code
    except OSError:
        pass
    code = compiled(machine, emit())
    partial = path.with_suffix(f".{os.getpid()}")
    try:
        partial.write_bytes(hashlib.sha256(code).digest() + code)
        partial.replace(path)
    except OSError:  # no space, or no permission: the code runs all the same
        with contextlib.suppress(OSError):
            partial.unlink()
    return code
