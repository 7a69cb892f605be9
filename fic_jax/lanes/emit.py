"""LLVM IR of a graph: each scalar becomes a vector of lanes, a uniform one stays scalar.

This file writes the function, its loops and its branches; instructions.py writes single operations.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from fic_jax.lanes.graph import Branch, Loop, Node, capture, live, ordered
from fic_jax.lanes.instructions import Instructions

INT32, INT64 = ir.IntType(32), ir.IntType(64)


def llvm_ir(roots: Sequence[Node], dtype: np.dtype, lanes: int, mask_bits: int) -> str:
    """The module with `run(columns, results, uniforms, stride, first, last)` for a graph.

    columns[i * stride + j] is column i of lane j, results alike; integers and bools have the width
    of the floats. Lanes first..last are computed, in whole vectors.
    """
    return _Writer(roots, dtype, lanes, mask_bits).function(roots)


class _Writer:
    """A builder, its instructions, and the values of the nodes computed so far."""

    def __init__(self, roots: Sequence[Node], dtype: np.dtype, lanes: int, mask_bits: int) -> None:
        self.build = ir.IRBuilder()
        self.instructions = Instructions(self.build, dtype, lanes, mask_bits)
        self.live = live(roots)
        capture(self.live)
        self.values: dict[Node, Any] = {}
        self.spread: dict[Node, Any] = {}  # uniform ones as vectors

    def function(self, roots: Sequence[Node]) -> str:
        """The text of the module: a loop over vectors of lanes."""
        build, real = self.build, self.instructions.real
        vector, aligned = self.instructions.vector(real), self.instructions.bits // 8
        function = _declared(real)
        columns, results, uniforms, stride, first, last = function.args
        entry, body, exit_ = map(function.append_basic_block, ("entry", "vector", "exit"))
        build.position_at_end(entry)
        inputs = [node for node in self.live if node.op == "input"]
        for node in inputs:
            if node.uniform:
                place = build.gep(uniforms, [INT64(node.value)])
                self.define(node, self._as_kind(node, build.load(place)))
        build.branch(body)
        build.position_at_end(body)
        at = build.phi(INT64)
        at.add_incoming(first, entry)

        def place_of(base: Any, i: int) -> Any:
            offset = build.add(build.mul(stride, INT64(i)), at)
            return build.bitcast(build.gep(base, [offset]), vector.as_pointer())

        for node in inputs:
            if not node.uniform:
                loaded = build.load(place_of(columns, node.value), align=aligned)
                self.define(node, self._as_kind(node, loaded))
        self.compute(roots)
        for i, root in enumerate(roots):
            value = self.get(root, uniform=False)
            if root.kind == "b":
                value = self.instructions.widened(value, self.instructions.alike("i", value.type))
            build.store(build.bitcast(value, vector), place_of(results, i), align=aligned)
        following = build.add(at, INT64(self.instructions.lanes))
        at.add_incoming(following, build.block)
        build.cbranch(build.icmp_signed("<", following, last), body, exit_)
        build.position_at_end(exit_)
        build.ret_void()
        return str(build.module)

    def _as_kind(self, node: Node, loaded: Any) -> Any:
        """A loaded number as a value of the node's kind."""
        if node.kind == "f":
            return loaded
        whole = self.build.bitcast(loaded, self.instructions.alike("i", loaded.type))
        if node.kind == "i":
            return whole
        zero = self.instructions.constant(whole.type, 0)
        return self.instructions.compared("!=", "i", whole, zero)

    def compute(self, roots: Iterable[Node]) -> None:
        """Write the instructions of all nodes that the roots need and that have no value yet."""
        for node in ordered(roots, lambda n: () if n in self.values else n.needs()):
            if node in self.values:
                continue
            if isinstance(node.of, Loop):
                self.loop(node.of)
            elif isinstance(node.of, Branch):
                self.branch(node.of)
            else:
                args = [self.get(a, node.uniform) for a in node.args]
                self.define(node, self.instructions.of(node, args))

    def loop(self, loop: Loop) -> None:
        """Write a loop and define its results."""
        build, before = self.build, self.build.block
        phis = [n for n in self.live if n.op == "phi" and n.of is loop]
        results = [n for n in self.live if n.op == "result" and n.of is loop]
        inits = [self.get(loop.inits[p.value], p.uniform) for p in phis]
        body, after = map(build.append_basic_block, ("iteration", "after"))
        build.branch(body)
        build.position_at_end(body)
        k = build.phi(INT32)
        carried = [build.phi(init.type) for init in inits]
        for phi, value in zip(phis, carried, strict=True):
            self.define(phi, value)
        needed = sorted({n.value for n in (*phis, *results)})
        self.compute([*(loop.outs[i] for i in needed), *loop.until()])
        outs = [self.get(loop.outs[p.value], p.uniform) for p in phis]
        last = [self.get(loop.outs[r.value], r.uniform) for r in results]
        following = build.add(k, INT32(1))
        starts, nexts = [INT32(0), *inits], [following, *outs]
        for value, start, out in zip([k, *carried], starts, nexts, strict=True):
            value.add_incoming(start, before)
            value.add_incoming(out, build.block)
        if loop.goes_on:
            another = self.instructions.any_lane(self.get(loop.goes_on, loop.goes_on.uniform))
        else:
            another = build.icmp_signed("<", following, INT32(loop.length))
        build.cbranch(another, body, after)
        build.position_at_end(after)
        for result, value in zip(results, last, strict=True):
            self.define(result, value)

    def branch(self, branch: Branch) -> None:
        """Write a branch and define its results."""
        build = self.build
        results = [n for n in self.live if n.op == "result" and n.of is branch]
        instead = [self.get(branch.otherwise[r.value], uniform=False) for r in results]
        condition = self.get(branch.condition, branch.condition.uniform)
        any_lane = self.instructions.any_lane(condition)
        before, then, after = build.block, *map(build.append_basic_block, ("branch", "after"))
        build.cbranch(any_lane, then, after)
        build.position_at_end(then)
        self.compute(branch.outs[r.value] for r in results)
        computed = [self.get(branch.outs[r.value], uniform=False) for r in results]
        then = build.block
        build.branch(after)
        build.position_at_end(after)
        for result, value, other in zip(results, computed, instead, strict=True):
            either = build.phi(value.type)
            either.add_incoming(value, then)
            either.add_incoming(other, before)
            self.define(result, either)

    def define(self, node: Node, value: Any) -> None:
        """Record a node's value; spread a uniform one over a vector at once, outside of loops."""
        self.values[node] = value
        if node.uniform and not isinstance(value, ir.Constant):
            self.spread[node] = self.instructions.spread(value)

    def get(self, node: Node, uniform: bool) -> Any:
        """The value of a node, as a scalar or as a vector."""
        value = self.values[node]
        if uniform or not node.uniform:
            return value
        if isinstance(value, ir.Constant):
            return self.instructions.constant(self.instructions.vector(value.type), value.constant)
        return self.spread[node]


def _declared(real: Any) -> ir.Function:
    """The function without its body, in a module of its own."""
    pointer = real.as_pointer()
    types = [pointer, pointer, pointer, INT64, INT64, INT64]
    function = ir.Function(ir.Module("lanes"), ir.FunctionType(ir.VoidType(), types), "run")
    # otherwise spilled vectors lie across two cache lines, in some processes
    function.attributes.alignstack = 64
    function.attributes.add("nounwind")  # llvmlite drops an alignment that stands alone
    return function
