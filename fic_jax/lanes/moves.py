"""Taking nodes of a graph into a branch, and what has to be known for it."""

from collections.abc import Collection, Iterable
from typing import Any

from fic_jax.lanes.graph import Branch, Graph, Node, Scope

# Instructions, about; what isn't here is one.
COST = {"exp": 16, "sqrt": 6, "div": 6, "constant": 0, "phi": 0, "result": 0}
COSTLY = 16  # what a branch has to save if that is one operation (an exponential)
BULK = 40  # or many: less is not worth a mispredicted jump

Users = dict[Node, set[Node]]


def move(graph: Graph, inside: Iterable[Node], branch: Branch, nodes: Iterable[Node]) -> list[Node]:
    """Put nodes into a branch; whoever of the live `nodes` uses its `outs` takes its results."""
    results = [
        graph.place("result", out.kind, i, uniform=False, scope=branch.outer, of=branch)
        for i, out in enumerate(branch.outs)
    ]
    instead = dict(zip(branch.outs, results, strict=True))
    gone = set(inside)
    graph.forget(gone)  # while those who use them still name them
    substitute(nodes, instead, gone)
    for node in gone:
        node.scope = branch
    return results


def substitute(
    nodes: Iterable[Node], instead: dict[Node, Node], but: Collection[Node] = ()
) -> None:
    """Have the live `nodes`, `but` some, and their loops and branches use others `instead`."""
    scopes: dict[Any, None] = {}
    for node in nodes:
        if node not in but and not instead.keys().isdisjoint(node.args):
            node.args = tuple(instead.get(a, a) for a in node.args)
        if node.of:
            scopes[node.of] = None
    for scope in scopes:
        scope.replace(instead)


def convex(nodes: Collection[Node], everything: Iterable[Node]) -> list[Node]:
    """Those of the nodes that need nothing outside that itself needs one of them."""
    wanted = set(nodes)
    inside: set[Node] = set()
    later: set[Node] = set()
    for node in everything:
        before = node.before()
        if node in wanted and node.op not in ("phi", "result") and later.isdisjoint(before):
            inside.add(node)
        elif not (inside.isdisjoint(before) and later.isdisjoint(before)):
            later.add(node)
    return [n for n in nodes if n in inside]


def users_of(nodes: Iterable[Node]) -> Users:
    """Who needs each of the live nodes, as an operand or to make a phi or result from it."""
    users: Users = {n: set() for n in nodes}
    for node in nodes:
        for needed in (*node.args, *(node.of.makes(node.value) if node.of else ())):
            users[needed].add(node)
    return users


def outs_of(inside: Collection[Node], everything: Iterable[Node]) -> list[Node]:
    """Those of some nodes that others use."""
    users = users_of(everything)
    return [n for n in inside if not users[n].issubset(inside)]


def dependants(first: Iterable[Node], nodes: Iterable[Node]) -> set[Node]:
    """Nodes and all that can't be computed before them."""
    later = set(first)
    for node in nodes:
        if not later.isdisjoint(node.before()):
            later.add(node)
    return later


def ancestors(node: Node) -> set[Node]:
    """A node and all that is computed before it."""
    before: set[Node] = set()
    stack = [node]
    while stack:
        node = stack.pop()
        if node not in before:
            before.add(node)
            stack += node.before()
    return before


def cost(node: Node) -> int:
    """Instructions, about."""
    return COST.get(node.op, 1)


def visible(node: Node, scope: Scope | None) -> bool:
    """Whether a node is computed in a scope or around it."""
    while scope and scope is not node.scope:
        scope = scope.outer
    return scope is node.scope
