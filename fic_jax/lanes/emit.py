"""LLVM IR of a graph's nodes, loops and branches, for vectors of lanes or for single threads.

vectors.py and threads.py write the function around them, instructions.py single operations.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from llvmlite import ir

from fic_jax.lanes.graph import Branch, Loop, Node, Scope, capture, live, ordered
from fic_jax.lanes.instructions import Instructions

INT32 = ir.IntType(32)
SHORT = (
    600  # operations of a loop that may be unrolled: a longer one outgrows the instruction cache
)


class Writer:
    """A builder, its instructions, and the values of the nodes computed so far."""

    def __init__(
        self, instructions: Instructions, roots: Sequence[Node], unrolled: int = 1
    ) -> None:
        self.build, self.instructions = instructions.build, instructions
        self.unrolled = unrolled  # iterations written one after the other, where they divide a loop
        self.live = live(roots)
        capture(self.live)
        self.values: dict[Node, Any] = {}
        self.spread: dict[Node, Any] = {}  # uniform ones as vectors

    def inputs(self, *, uniform: bool) -> list[Node]:
        """The inputs that are in use: those that are the same for all lanes, or the others."""
        return [node for node in self.live if node.op == "input" and node.uniform == uniform]

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
        together = self._together(loop)
        for copy in range(together):
            known = len(self.values)
            self.compute([*(loop.outs[i] for i in needed), *loop.until()])
            outs = [self.get(loop.outs[p.value], p.uniform) for p in phis]
            last = [self.get(loop.outs[r.value], r.uniform) for r in results]
            if copy + 1 < together:
                for node in list(self.values)[known:]:  # the next iteration computes them anew
                    del self.values[node]
                for phi, out in zip(phis, outs, strict=True):
                    self.define(phi, out)
        following = build.add(k, INT32(together))
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

    def _together(self, loop: Loop) -> int:
        """Iterations of a loop that are written one after the other, for the registers' sake."""
        inside = [node for node in self.live if node.scope and _lies_in(node.scope, loop)]
        divides = loop.length and loop.length % self.unrolled == 0
        return self.unrolled if divides and len(inside) <= SHORT else 1

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


def _lies_in(scope: Scope | None, loop: Loop) -> bool:
    """Whether a scope is a loop, or a part of it."""
    return scope is loop or (scope is not None and _lies_in(scope.outer, loop))
