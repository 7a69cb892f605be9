"""LLVM IR of a graph as a function for a CPU: each scalar becomes a vector of lanes.

A uniform scalar stays one.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from fic_jax.lanes.emit import Writer
from fic_jax.lanes.graph import Node
from fic_jax.lanes.instructions import Instructions

INT64 = ir.IntType(64)


def vector_ir(roots: Sequence[Node], dtype: np.dtype, lanes: int, mask_bits: int) -> str:
    """The module with `run(columns, results, uniforms, stride, first, last)` for a graph.

    columns[i * stride + j] is column i of lane j, results alike; integers and bools have the width
    of the floats. Lanes first..last are computed, in whole vectors.
    """
    build = ir.IRBuilder()
    instructions = Instructions(build, dtype, lanes, mask_bits)
    writer = Writer(instructions, roots)
    vector, aligned = instructions.vector(instructions.real), instructions.bits // 8
    function = _declared(instructions.real)
    columns, results, uniforms, stride, first, last = function.args
    entry, body, exit_ = map(function.append_basic_block, ("entry", "vector", "exit"))
    build.position_at_end(entry)
    for node in writer.inputs(uniform=True):
        loaded = build.load(build.gep(uniforms, [INT64(node.value)]))
        writer.define(node, _as_kind(node.kind, loaded, instructions))
    build.branch(body)
    build.position_at_end(body)
    at = build.phi(INT64)
    at.add_incoming(first, entry)

    def place_of(base: Any, i: int) -> Any:
        offset = build.add(build.mul(stride, INT64(i)), at)
        return build.bitcast(build.gep(base, [offset]), vector.as_pointer())

    for node in writer.inputs(uniform=False):
        loaded = build.load(place_of(columns, node.value), align=aligned)
        writer.define(node, _as_kind(node.kind, loaded, instructions))
    writer.compute(roots)
    for i, root in enumerate(roots):
        value = writer.get(root, uniform=False)
        if root.kind == "b":
            value = instructions.widened(value, instructions.alike("i", value.type))
        build.store(build.bitcast(value, vector), place_of(results, i), align=aligned)
    following = build.add(at, INT64(lanes))
    at.add_incoming(following, build.block)
    build.cbranch(build.icmp_signed("<", following, last), body, exit_)
    build.position_at_end(exit_)
    build.ret_void()
    return str(build.module)


def _as_kind(kind: str, loaded: Any, instructions: Instructions) -> Any:
    """A loaded number as a value of its kind."""
    if kind == "f":
        return loaded
    whole = instructions.build.bitcast(loaded, instructions.alike("i", loaded.type))
    if kind == "i":
        return whole
    return instructions.compared("!=", "i", whole, instructions.constant(whole.type, 0))


def _declared(real: Any) -> ir.Function:
    """The function without its body, in a module of its own."""
    pointer = real.as_pointer()
    types = [pointer, pointer, pointer, INT64, INT64, INT64]
    function = ir.Function(ir.Module("lanes"), ir.FunctionType(ir.VoidType(), types), "run")
    # otherwise spilled vectors lie across two cache lines, in some processes
    function.attributes.alignstack = 64
    function.attributes.add("nounwind")  # llvmlite drops an alignment that stands alone
    return function
