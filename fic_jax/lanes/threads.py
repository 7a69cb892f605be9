"""PTX of a graph as a kernel for an NVIDIA GPU: each lane becomes a thread.

The operations are those of a CPU's vectors, and PTX rounds each as IEEE 754 wants, also divisions
and denormal numbers: a thread computes the bits that a CPU's lane computes.
"""

from collections.abc import Sequence
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir

from fic_jax.lanes.emit import Writer
from fic_jax.lanes.graph import Node
from fic_jax.lanes.instructions import Instructions

KERNEL = "run"
THREADS = 128  # of a block, which starts and ends together
UNROLLED = 2  # iterations of a loop: no value moves to the register that the next one reads
INT32, INT64 = ir.IntType(32), ir.IntType(64)


def thread_ir(
    roots: Sequence[Node], dtype: np.dtype, arguments: Sequence[Any], results: Sequence[Any]
) -> str:
    """The module with the kernel `run(columns..., results..., strides..., n)` for a graph.

    Column and result are pointers to numbers of the given types; a bool is a byte. Thread j of n
    reads column[stride * j], where the stride is 0 or 1, and writes result[j].
    """
    build = ir.IRBuilder()
    instructions = Instructions(build, dtype, lanes=1, mask_bits=1)
    writer = Writer(instructions, roots, UNROLLED)
    stored = [_stored(one) for one in (*arguments, *results)]
    types = [*(of.as_pointer() for of in stored), *len(arguments) * [INT32], INT64]
    module = ir.Module("threads")
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), types), KERNEL)
    for name, value in {"kernel": 1, "maxntidx": THREADS}.items():
        note = module.add_metadata([function, name, INT32(value)])
        module.add_named_metadata("nvvm.annotations", note)
    pointers, strides, n = (
        function.args[: len(stored)],
        function.args[len(stored) : -1],
        function.args[-1],
    )

    entry, body, exit_ = map(function.append_basic_block, ("entry", "thread", "exit"))
    build.position_at_end(entry)
    block, size, thread = (
        build.zext(instructions.called(f"nvvm.read.ptx.sreg.{name}.x", INT32), INT64)
        for name in ("ctaid", "ntid", "tid")
    )
    j = build.add(build.mul(block, size), thread)
    build.cbranch(build.icmp_unsigned("<", j, n), body, exit_)
    build.position_at_end(body)
    for node in writer.inputs(uniform=False):
        at = build.mul(build.zext(strides[node.value], INT64), j)
        loaded = build.load(build.gep(pointers[node.value], [at]))
        writer.define(node, _from_memory(node.kind, loaded, instructions))
    writer.compute(roots)
    for root, pointer in zip(roots, pointers[len(arguments) :], strict=True):
        value = _to_memory(root.kind, writer.get(root, uniform=False), pointer.type.pointee, build)
        build.store(value, build.gep(pointer, [j]))
    build.branch(exit_)
    build.position_at_end(exit_)
    build.ret_void()
    return str(module)


def ptx(text: str, capability: tuple[int, int]) -> str:
    """PTX of a module for GPUs of at least this compute capability.

    Raises RuntimeError if LLVM was built without NVPTX, or does not know the capability.
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple("nvptx64-nvidia-cuda")
    machine = target.create_target_machine(cpu="sm_{}{}".format(*capability), opt=3)
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    return str(machine.emit_assembly(module))


def _stored(of: Any) -> ir.Type:
    """The type of a number in memory."""
    kind, bits = np.dtype(of).kind, 8 * np.dtype(of).itemsize
    if kind == "f":
        return ir.FloatType() if bits == 32 else ir.DoubleType()
    return ir.IntType(bits)


def _from_memory(kind: str, loaded: Any, instructions: Instructions) -> Any:
    """A loaded number as a value of its kind."""
    build = instructions.build
    if kind == "f":
        return loaded
    if kind == "b":
        return build.icmp_unsigned("!=", loaded, loaded.type(0))
    return _resized(loaded, instructions.int, build)


def _to_memory(kind: str, value: Any, of: ir.Type, build: ir.IRBuilder) -> Any:
    """A value of some kind as it is stored."""
    if kind == "f":
        return value
    return build.zext(value, of) if kind == "b" else _resized(value, of, build)


def _resized(value: Any, of: ir.IntType, build: ir.IRBuilder) -> Any:
    """An integer in another width."""
    if value.type.width == of.width:
        return value
    return build.sext(value, of) if value.type.width < of.width else build.trunc(value, of)
