"""The compile cache: code beside JAX's compiled programs (`jax_compilation_cache_dir`)."""

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import jax
import llvmlite
import llvmlite.binding as llvm

from fic_jax.lanes.sources import digest


def cached(key: str | None, target: str, suffix: str, build: Callable[[], bytes]) -> bytes:
    """The code that `build` returns, from the compile cache if it has it.

    `key` identifies the function among all that the package compiles, `target` what it is compiled
    for. Without a key or without a cache it reads and writes no file.
    """
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    sources = digest(Path(__file__).parent)
    if not (key and folder and sources):
        return build()
    versions = f"jax {jax.__version__} llvmlite {llvmlite.__version__} {llvm.llvm_version_info}"
    name = hashlib.sha256(f"{key}\n{sources}\n{versions}\n{target}".encode()).hexdigest()
    path = Path(folder) / f"lanes-{name[:32]}.{suffix}"
    try:
        content = path.read_bytes()
        checksum, code = content[:32], content[32:]
        if hashlib.sha256(code).digest() == checksum:
            return code
    except OSError:
        pass
    code = build()
    partial = path.with_suffix(f".{os.getpid()}")
    try:
        partial.write_bytes(hashlib.sha256(code).digest() + code)
        partial.replace(path)
    except OSError:  # no space, or no permission: the code runs all the same
        with contextlib.suppress(OSError):
            partial.unlink()
    return code
