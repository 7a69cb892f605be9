"""The graph of a scenario's operations on scalars, with its loops and branches.

Equal operations are one, and an operation lies in the outermost loop its operands allow.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np

ZERO = {"f": 0.0, "i": 0, "b": False}  # of each kind of number


class Untranslatable(Exception):  # noqa: N818  another arrangement takes over; nobody erred
    """What of a traced function there is no kernel for."""


@dataclass(eq=False)
class Scope:
    """Where nodes are computed, if not once for all: in the turns of a loop, or in a branch."""

    outer: "Scope | None"
    outs: "list[Node]" = field(default_factory=list)
    captured: "dict[Node, None]" = field(default_factory=dict)  # what it needs from outside

    @property
    def depth(self) -> int:
        """Scopes around this one, and itself."""
        return 1 + depth(self.outer)


@dataclass(eq=False)
class Loop(Scope):
    """Turns of known number: `outs` of one are `phis` of the next."""

    length: int = 1
    inits: "list[Node]" = field(default_factory=list)
    phis: "list[Node]" = field(default_factory=list)

    def entered_with(self) -> "list[Node]":
        """What has to be there before the first turn."""
        return self.inits

    def makes(self, i: int) -> "tuple[Node, ...]":
        """What phi and result i depend on."""
        return self.outs[i], self.inits[i]

    def replace(self, instead: "dict[Node, Node]") -> None:
        """Use other nodes."""
        self.outs = [instead.get(n, n) for n in self.outs]
        self.inits = [instead.get(n, n) for n in self.inits]


@dataclass(eq=False)
class Branch(Scope):
    """Computed where any scenario of the vector meets the condition; `otherwise` stands in."""

    condition: "Node" = field(kw_only=True)
    otherwise: "list[Node]" = field(default_factory=list)
    demand: Any = frozenset([frozenset()])  # the condition as branches.py writes it

    def entered_with(self) -> "list[Node]":
        """What has to be there in any case."""
        return [self.condition, *self.otherwise]

    def makes(self, i: int) -> "tuple[Node, ...]":
        """What result i depends on."""
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
    op: str
    args: "tuple[Node, ...]"
    kind: str  # f, i or b: float, integer, bool
    scope: Scope | None  # where it is computed
    uniform: bool  # the same for all scenarios
    value: Any = None  # of a constant; the index of an input, phi or result; an exponent
    of: Any = None  # the loop or branch whose phi or result it is

    def before(self) -> "tuple[Node, ...]":
        """What is computed before it: for a result, all that its loop or branch computes."""
        if self.op != "result":
            return self.args
        return (*self.of.outs, *self.of.entered_with())

    def needs(self) -> "tuple[Node, ...]":
        """What of its own scope, or of one around, is computed before it; known by `capture`."""
        return tuple(self.of.captured) if self.op == "result" else self.args

    def __repr__(self) -> str:
        of = f" of {id(self.of)}" if self.of else ""
        return f"{self.id}: {self.op} {self.value} {[a.id for a in self.args]}{of}"


def depth(scope: Scope | None) -> int:
    """Scopes around a node of `scope`."""
    return scope.depth if scope else 0


class Graph:
    """Nodes, each built once."""

    def __init__(self, dtype: np.dtype) -> None:
        self.dtype = dtype
        self._known: dict[Any, Node] = {}
        self._ids = count()

    def node(self, op: str, args: Sequence[Node], kind: str, value: Any = None) -> Node:
        """The node of an operation."""
        key = self._key(op, args, kind, value)
        if key not in self._known:
            scope = max((a.scope for a in args), key=depth, default=None)
            uniform = all(a.uniform for a in args)
            self._known[key] = Node(next(self._ids), op, tuple(args), kind, scope, uniform, value)
        return self._known[key]

    def known(self, op: str, args: Sequence[Node], kind: str, value: Any = None) -> Node | None:
        """The node of an operation, if there is one."""
        return self._known.get(self._key(op, args, kind, value))

    def _key(self, op: str, args: Sequence[Node], kind: str, value: Any) -> Any:
        # a bool equals an integer, and -0.0 equals 0.0: told apart by their names
        return (op, *(a.id for a in args), kind, repr(value))

    def forget(self, nodes: Iterable[Node]) -> None:
        """Never give these to anybody else, nor what depends on them."""
        gone = set(nodes)
        for node in sorted(self._known.values(), key=lambda node: node.id):
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
        """An input of the whole, or a phi or result of the scope `of`."""
        return Node(next(self._ids), op, (), kind, scope, uniform, value, of)

    def constant(self, value: Any, kind: str = "f") -> Node:
        """A number; one written in the program may be of any width."""
        if np.ndim(value):
            raise Untranslatable(f"an array of shape {np.shape(value)}")
        return self.node("constant", (), kind, np.asarray(value).item())


def live(roots: Iterable[Node]) -> list[Node]:
    """All nodes the roots depend on, also through turns of loops, in an order to compute them."""
    seen: set[Node] = set()
    stack = list(roots)
    while stack:
        node = stack.pop()
        if node not in seen:
            seen.add(node)
            stack += (*node.args, *(node.of.makes(node.value) if node.of else ()))
    return ordered(roots, lambda node: [n for n in node.before() if n in seen])


def loops(roots: Iterable[Node]) -> list[Loop]:
    """The loops that the roots depend on."""
    return list(dict.fromkeys(node.of for node in live(roots) if isinstance(node.of, Loop)))


def ordered(roots: Iterable[Node], before: Callable[[Node], Iterable[Node]]) -> list[Node]:
    """The roots and all that comes before them, each after what comes before it."""
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


def capture(nodes: Iterable[Node]) -> None:
    """Note in each loop and branch what the live `nodes` in it need from outside."""

    def note(scope: Scope | None, needed: Node) -> None:
        while scope is not needed.scope:
            assert scope
            scope.captured[needed] = None
            scope = scope.outer

    for node in nodes:
        for arg in node.args:
            note(node.scope, arg)
        for needed in node.of.makes(node.value) if node.of else ():
            note(node.of, needed)
