"""From LLVM's text to a function of this processor, kept in JAX's folder of compiled programs."""

import ctypes
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import llvmlite
import llvmlite.binding as llvm

import fic_jax
from fic_jax._version import LOADED


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


def register_bytes() -> int:
    """Width of this processor's vectors."""
    features = llvm.get_host_cpu_features()
    return 64 if features.get("avx512f") else 32 if features.get("avx") else 16


class Function:
    """`run` of a module: a C function, and the memory it lies in."""

    def __init__(self, machine: llvm.TargetMachine, code: bytes, real: Any) -> None:
        empty = llvm.parse_assembly("")
        empty.triple, empty.data_layout = machine.triple, str(machine.target_data)
        self._memory = llvm.create_mcjit_compiler(empty, machine)  # as long as the function lives
        self._memory.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._memory.finalize_object()
        types = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64]
        self.call = ctypes.CFUNCTYPE(None, *types, real)(self._memory.get_function_address("run"))


def compiled(machine: llvm.TargetMachine, text: str) -> bytes:
    """The machine code of a module.

    Every value of it is in its register already: LLVM's own passes over the text would gain
    nothing, and turn conditions into bits.
    """
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    return bytes(machine.emit_object(module))


def kept(identity: str, machine: llvm.TargetMachine, make: Callable[[], str]) -> bytes:
    """The machine code of what `make` writes, as it was kept if it was: tracing takes longest.

    `identity` names what is written, given the sources of this package and the versions of others.
    """
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    sources = _sources()
    if not (folder and sources):
        return compiled(machine, make())
    versions = f"{sources} jax {jax.__version__} llvmlite {llvmlite.__version__}"
    versions += f" LLVM {llvm.llvm_version_info}"
    processor = f"{llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"
    name = hashlib.sha256(f"{identity} {versions} {machine.triple} {processor}".encode())
    path = Path(folder) / f"fic_jax-{name.hexdigest()[:32]}.o"
    try:
        digest, code = (content := path.read_bytes())[:32], content[32:]
        if hashlib.sha256(code).digest() == digest:
            return code
    except OSError:
        pass
    code = compiled(machine, make())
    own = path.with_suffix(f".{os.getpid()}")
    try:
        own.write_bytes(hashlib.sha256(code).digest() + code)
        own.replace(path)
    except OSError:  # no room, or not ours to write in: no reason not to run
        own.unlink(missing_ok=True)
    return code


def _sources() -> str | None:
    """A digest of this package's files; None if one is younger than what this process loaded."""
    digest, root = hashlib.sha256(), Path(fic_jax.__file__).parent
    for path in sorted(root.rglob("*.py")):
        if path.stat().st_mtime > LOADED:
            return None
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()
