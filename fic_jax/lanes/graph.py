"""The graph of a scalar function's operations, with its loops and branches.

Equal operations are one node (common-subexpression elimination). A node lies in the outermost loop
that its operands allow (loop-invariant code motion).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np

ZERO = {"f": 0.0, "i": 0, "b": False}  # of each kind of number


class Untranslatable(Exception):  # noqa: N818  not the caller's error: XLA can compile it
    """The traced function uses an operation that the lane compiler does not support."""


@dataclass(eq=False)
class Scope:
    """A loop or a branch. A node is computed in a scope, or (None) once for the whole function."""

    outer: "Scope | None"
    outs: "list[Node]" = field(default_factory=list)
    captured: "dict[Node, None]" = field(default_factory=dict)  # nodes from outside that it uses

    @property
    def depth(self) -> int:
        """Scopes around this one, and itself."""
        return 1 + depth(self.outer)


@dataclass(eq=False)
class Loop(Scope):
    """A loop: the `outs` of an iteration are the `phis` of the next.

    Of known length, or as long as a lane `goes_on`; one that does not keeps its numbers.
    """

    length: int = 0
    goes_on: "Node | None" = None
    inits: "list[Node]" = field(default_factory=list)
    phis: "list[Node]" = field(default_factory=list)

    def entered_with(self) -> "list[Node]":
        """The nodes that are computed before the loop."""
        return self.inits

    def makes(self, i: int) -> "tuple[Node, ...]":
        """The nodes that phi and result i depend on."""
        return self.outs[i], self.inits[i], *self.until()

    def until(self) -> "tuple[Node, ...]":
        """The node that decides about another iteration, if it is not their number."""
        return (self.goes_on,) if self.goes_on else ()

    def replace(self, instead: "dict[Node, Node]") -> None:
        """Use other nodes."""
        self.outs = [instead.get(n, n) for n in self.outs]
        self.inits = [instead.get(n, n) for n in self.inits]
        if self.goes_on:
            self.goes_on = instead.get(self.goes_on, self.goes_on)


@dataclass(eq=False)
class Branch(Scope):
    """A branch, entered if any lane meets the condition; if not, its results are `otherwise`."""

    condition: "Node" = field(kw_only=True)
    otherwise: "list[Node]" = field(default_factory=list)

    def entered_with(self) -> "list[Node]":
        """The nodes that are computed before the branch."""
        return [self.condition, *self.otherwise]

    def makes(self, i: int) -> "tuple[Node, ...]":
        """The nodes that result i depends on."""
        return self.outs[i], self.condition, self.otherwise[i]

    def replace(self, instead: "dict[Node, Node]") -> None:
        """Use other nodes."""
        self.outs = [instead.get(n, n) for n in self.outs]
        self.condition = instead.get(self.condition, self.condition)
        self.otherwise = [instead.get(n, n) for n in self.otherwise]


@dataclass(eq=False)
class Node:
    """One operation on scalars."""

    id: int  # operands have smaller ones
    op: str  # a primitive of JAX; or input, phi, result, constant, fma
    args: "tuple[Node, ...]"
    kind: str  # f, i or b: float, integer, bool
    scope: Scope | None  # where it is computed
    uniform: bool  # the same for all lanes
    value: Any = None  # of a constant; index of an input, phi or result; an exponent; a hint
    of: Any = None  # the loop or branch whose phi or result it is

    def uses(self) -> "tuple[Node, ...]":
        """Its operands; for a phi or result, the nodes that its loop or branch makes it of."""
        return self.of.makes(self.value) if self.of else self.args

    def before(self) -> "tuple[Node, ...]":
        """The nodes computed before it: for a result, all that its loop or branch computes."""
        if self.op != "result":
            return self.args
        return (*self.of.outs, *self.of.entered_with())

    def needs(self) -> "tuple[Node, ...]":
        """The nodes outside its loop or branch that it needs first (call `capture` before)."""
        return tuple(self.of.captured) if self.op == "result" else self.args

    def replace(self, instead: "dict[Node, Node]") -> None:
        """Use other nodes, also in the loop or branch whose phi or result it is."""
        self.args = tuple(instead.get(a, a) for a in self.args)
        if self.of:
            self.of.replace(instead)

    def __repr__(self) -> str:
        of = f" of {id(self.of)}" if self.of else ""
        return f"{self.id}: {self.op} {self.value} {[a.id for a in self.args]}{of}"


def depth(scope: Scope | None) -> int:
    """Scopes around a node of `scope`."""
    return scope.depth if scope else 0


class Graph:
    """Makes nodes; the same operation on the same operands is one node."""

    def __init__(self, dtype: np.dtype) -> None:
        self.dtype = dtype
        self._known: dict[Any, Node] = {}
        self.ids = count()

    def node(self, op: str, args: Sequence[Node], kind: str, value: Any = None) -> Node:
        """The node of an operation."""
        key = self._key(op, args, kind, value)
        scope = max((a.scope for a in args), key=depth, default=None)
        known = self._known.get(key)
        if known is None or known.scope is not scope:  # a branch may have taken it in
            uniform = all(a.uniform for a in args)
            known = Node(next(self.ids), op, tuple(args), kind, scope, uniform, value)
            self._known[key] = known
        return known

    def known(self, op: str, args: Sequence[Node], kind: str, value: Any = None) -> Node | None:
        """The node of an operation, if it exists."""
        return self._known.get(self._key(op, args, kind, value))

    def _key(self, op: str, args: Sequence[Node], kind: str, value: Any) -> Any:
        # by name: a bool equals an integer, and -0.0 equals 0.0
        return (op, *(a.id for a in args), kind, repr(value))

    def forget(self, nodes: Iterable[Node]) -> None:
        """Let later operations share neither these nodes nor those that depend on them."""
        gone = set(nodes)
        for node in self._known.values():  # by their ids
            if not gone.isdisjoint(node.args):
                gone.add(node)
        self._known = {key: node for key, node in self._known.items() if node not in gone}

    def place(
        self,
        op: str,
        kind: str,
        value: int,
        *,
        uniform: bool,
        scope: Scope | None = None,
        of: Scope | None = None,
    ) -> Node:
        """An input of the function, or a phi or result of the scope `of`."""
        return Node(next(self.ids), op, (), kind, scope, uniform, value, of)

    def constant(self, value: Any, kind: str = "f") -> Node:
        """A number."""
        if np.ndim(value):
            raise Untranslatable(f"an array of shape {np.shape(value)}")
        number = np.asarray(value).item()
        if kind == "i" and not -(2**31) <= number < 2**31:
            raise Untranslatable(f"the integer {number}")
        return self.node("constant", (), kind, number)


def live(roots: Iterable[Node]) -> list[Node]:
    """All nodes that the roots depend on, also through iterations, in topological order."""
    seen: set[Node] = set()
    stack = list(roots)
    while stack:
        node = stack.pop()
        if node not in seen:
            seen.add(node)
            stack += node.uses()
    carried: dict[Scope, set[int]] = {}  # indices of the results that are used
    for node in seen:
        if node.of:
            carried.setdefault(node.of, set()).add(node.value)

    def before(node: Node) -> Iterable[Node]:
        if node.op != "result":
            return node.args
        return [n for i in sorted(carried[node.of]) for n in node.of.makes(i)]

    return ordered(roots, before)


def loops(roots: Iterable[Node]) -> list[Loop]:
    """The loops that the roots depend on."""
    return list(dict.fromkeys(node.of for node in live(roots) if isinstance(node.of, Loop)))


def ordered(roots: Iterable[Node], before: Callable[[Node], Iterable[Node]]) -> list[Node]:
    """The roots and all that comes before them, in topological order."""
    order: dict[Node, None] = {}
    entered: set[Node] = set()
    stack = list(roots)[::-1]
    while stack:
        node = stack[-1]
        waiting = [n for n in before(node) if n not in order]
        if node in order or not waiting:
            order[stack.pop()] = None
        else:
            assert node not in entered, f"{node} comes before itself"
            entered.add(node)
            stack += waiting[::-1]
    return list(order)


def users_of(nodes: Iterable[Node]) -> dict[Node, set[Node]]:
    """The users of each of the live nodes (`Node.uses`)."""
    users: dict[Node, set[Node]] = {n: set() for n in nodes}
    for node in nodes:
        for used in node.uses():
            users[used].add(node)
    return users


def replace(nodes: Iterable[Node], instead: dict[Node, Node]) -> None:
    """Replace operands of the live `nodes`, and of their loops and branches."""
    for node in nodes:
        node.replace(instead)


def capture(nodes: Iterable[Node]) -> None:
    """Record for each loop and branch the outer nodes that the live `nodes` in it use."""

    def note(scope: Scope | None, used: Node) -> None:
        while scope is not used.scope:
            assert scope
            scope.captured[used] = None
            scope = scope.outer

    for node in nodes:
        for arg in node.args:
            note(node.scope, arg)
        if node.of:
            for used in node.of.makes(node.value):
                note(node.of, used)
