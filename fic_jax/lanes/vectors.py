"""LLVM's words for a graph: each scalar becomes a vector of scenarios, a uniform one stays scalar.

Here are its loops and branches; what is written for a single operation is in operations.py.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from fic_jax.lanes.graph import Branch, Loop, Node, capture, live, ordered
from fic_jax.lanes.operations import Operations

INT32, INT64 = ir.IntType(32), ir.IntType(64)


def kernel(roots: Sequence[Node], n_columns: int, dtype: np.dtype, lanes: int) -> str:
    """LLVM IR of `run(columns, results, stride, first, last, dt)` for graphs after `branch_out`.

    columns[i * stride + j] is quantity i of scenario j, results alike; integers and conditions are
    written in the numbers' width. Scenarios first..last, in whole vectors, are computed.
    """
    return _Writer(roots, dtype, lanes).function(roots, n_columns)


class _Writer:
    """A builder, its operations, and the values of the nodes computed so far."""

    def __init__(self, roots: Sequence[Node], dtype: np.dtype, lanes: int) -> None:
        self.build = ir.IRBuilder()
        self.operations = Operations(self.build, dtype, lanes)
        self.live = live(roots)
        capture(self.live)
        self.values: dict[Node, Any] = {}
        self.spread: dict[Node, Any] = {}  # uniform ones as vectors

    def function(self, roots: Sequence[Node], n_columns: int) -> str:
        """The text of the whole: a loop over vectors of scenarios."""
        build, real = self.build, self.operations.real
        numbers, aligned = self.operations.vector(real), self.operations.bits // 8
        function = _declared(real)
        columns, results, stride, first, last, dt = function.args
        before, turn, after = map(function.append_basic_block, ("before", "vector", "after"))
        build.position_at_end(before)
        build.branch(turn)
        build.position_at_end(turn)
        at = build.phi(INT64)
        at.add_incoming(first, before)

        def place(base: Any, i: int) -> Any:
            offset = build.add(build.mul(stride, INT64(i)), at)
            return build.bitcast(build.gep(base, [offset]), numbers.as_pointer())

        for node in self.live:
            if node.op == "input":
                column = node.value < n_columns
                value = build.load(place(columns, node.value), align=aligned) if column else dt
                self.define(node, value)
        self.compute(roots)
        for i, root in enumerate(roots):
            value = build.bitcast(self.get(root, uniform=False), numbers)
            build.store(value, place(results, i), align=aligned)
        following = build.add(at, INT64(self.operations.lanes))
        at.add_incoming(following, build.block)
        build.cbranch(build.icmp_signed("<", following, last), turn, after)
        build.position_at_end(after)
        build.ret_void()
        return str(build.module)

    def compute(self, roots: Iterable[Node]) -> None:
        """Everything the roots need that isn't there yet."""
        for node in ordered(roots, lambda n: () if n in self.values else n.needs()):
            if node in self.values:
                continue
            if isinstance(node.of, Loop):
                self.loop(node.of)
            elif isinstance(node.of, Branch):
                self.branch(node.of)
            else:
                args = [self.get(a, node.uniform) for a in node.args]
                self.define(node, self.operations.operation(node, args))

    def loop(self, loop: Loop) -> None:
        """A loop and its results."""
        build, before = self.build, self.build.block
        phis = [n for n in self.live if n.op == "phi" and n.of is loop]
        results = [n for n in self.live if n.op == "result" and n.of is loop]
        inits = [self.get(loop.inits[p.value], p.uniform) for p in phis]
        turn, after = map(build.append_basic_block, ("turn", "after"))
        build.branch(turn)
        build.position_at_end(turn)
        k = build.phi(INT32)
        carried = [build.phi(init.type) for init in inits]
        for phi, value in zip(phis, carried, strict=True):
            self.define(phi, value)
        self.compute(loop.outs[i] for i in sorted({n.value for n in (*phis, *results)}))
        outs = [self.get(loop.outs[p.value], p.uniform) for p in phis]
        found = [self.get(loop.outs[r.value], r.uniform) for r in results]
        following = build.add(k, INT32(1))
        starts, nexts = [INT32(0), *inits], [following, *outs]
        for value, start, out in zip([k, *carried], starts, nexts, strict=True):
            value.add_incoming(start, before)
            value.add_incoming(out, build.block)
        build.cbranch(build.icmp_signed("<", following, INT32(loop.length)), turn, after)
        build.position_at_end(after)
        for result, value in zip(results, found, strict=True):
            self.define(result, value)

    def branch(self, branch: Branch) -> None:
        """A branch and its results."""
        build = self.build
        results = [n for n in self.live if n.op == "result" and n.of is branch]
        instead = [self.get(branch.otherwise[r.value], uniform=False) for r in results]
        condition = self.get(branch.condition, branch.condition.uniform)
        needed = self.operations.anywhere(condition)
        before, then, after = build.block, *map(build.append_basic_block, ("needed", "after"))
        build.cbranch(needed, then, after)
        build.position_at_end(then)
        self.compute(branch.outs[r.value] for r in results)
        found = [self.get(branch.outs[r.value], uniform=False) for r in results]
        then = build.block
        build.branch(after)
        build.position_at_end(after)
        for result, value, other in zip(results, found, instead, strict=True):
            either = build.phi(value.type)
            either.add_incoming(value, then)
            either.add_incoming(other, before)
            self.define(result, either)

    def define(self, node: Node, value: Any) -> None:
        """Note a node's value; a uniform one is spread over a vector at once, outside of loops."""
        self.values[node] = value
        if node.uniform and not isinstance(value, ir.Constant):
            self.spread[node] = self.operations.spread(value)

    def get(self, node: Node, uniform: bool) -> Any:
        """The value of a node, as a scalar or as a vector."""
        value = self.values[node]
        if uniform or not node.uniform:
            return value
        if isinstance(value, ir.Constant):
            return self.operations.constant(self.operations.vector(value.type), value.constant)
        return self.spread[node]


def _declared(real: Any) -> ir.Function:
    """The function without its body, in a module of its own."""
    pointer = real.as_pointer()
    types = [pointer, pointer, INT64, INT64, INT64, real]
    function = ir.Function(ir.Module("fic_jax"), ir.FunctionType(ir.VoidType(), types), "run")
    # or values that wait in memory lie across two lines of the cache, depending on the process
    function.attributes.alignstack = 64
    function.attributes.add("nounwind")  # llvmlite drops an alignment that stands alone
    return function
