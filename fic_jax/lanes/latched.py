"""Values that depend on a latch alone, one that a `where` may keep from turn to turn."""

from collections.abc import Collection, Iterable, Sequence

from fic_jax.lanes.demands import (
    ALWAYS,
    NEVER,
    Demand,
    demands,
    either,
    implies,
    met,
    uses,
    without,
)
from fic_jax.lanes.graph import ZERO, Branch, Graph, Loop, Node, live
from fic_jax.lanes.moves import COSTLY, cost, dependants, move, outs_of, users_of


def keep(graph: Graph, latch: Node, everything: list[Node], roots: Sequence[Node]) -> list[Node]:
    """Compute what is costly and depends on `latch` alone when that has changed, not before.

    `everything`, and what is returned, are the live nodes.
    """
    loop, (_, costly) = latch.scope, alone(latch, everything)
    if latch not in everything or not (costly and isinstance(loop, Loop)):
        return everything
    waiting = [with_feeders(costly, latch, everything)]
    while waiting:
        everything = live(roots)
        inside = [n for n in waiting.pop() if n in everything]
        _, wanted = demands(everything, loop)
        demand = without(
            either(NEVER, *(wanted[n] for n in outs_of(inside, everything))),
            dependants(inside, everything),
        )
        apart = parted(graph, inside, everything, loop) if demand == ALWAYS else []
        if apart:
            waiting += [apart, inside]
        elif demand != NEVER:
            put_behind_change(graph, latch, inside, demand, everything)
    return live(roots)


def put_behind_change(
    graph: Graph, latch: Node, inside: list[Node], demand: Demand, everything: list[Node]
) -> None:
    """Compute nodes where they are wanted and the latch has changed; elsewhere they are as kept."""
    loop, outs = latch.scope, outs_of(inside, everything)
    assert isinstance(loop, Loop)
    # What is kept at first is right for a latch of 0.
    zero = graph.constant(ZERO[latch.kind], latch.kind)
    by_latch, _ = alone(latch, everything)
    firsts = replayed(graph, [n for n in everything if n in by_latch], {latch: zero})
    key = carried(graph, loop, zero)
    kept = [key, *(carried(graph, loop, firsts[n]) for n in outs)]
    changed = graph.node("differs", (latch, key), "b")
    if demand != ALWAYS:
        changed = graph.node("and", (met(graph, demand), changed), "b")
    same = graph.node("copy", (latch,), latch.kind)
    branch = Branch(loop, [same, *outs], condition=changed, otherwise=list(kept))
    for phi, result in zip(kept, move(graph, [*inside, same], branch, everything), strict=True):
        loop.outs[phi.value] = result


def parted(
    graph: Graph, inside: Sequence[Node], everything: Sequence[Node], loop: Loop
) -> list[Node]:
    """A copy of some nodes for those users who want them under conditions known later.

    Conditions that themselves need the nodes can't tell when to compute them. Where that makes
    them needed more often than without such users, these get nodes of their own. The copy is empty
    where that gains nothing.
    """
    nodes, wanted = demands(everything, loop)
    later = dependants(inside, everything)
    at_once, late = NEVER, []
    for node in nodes:
        if node in inside:
            continue
        part = either(NEVER, *(d for used, d in uses(node, wanted[node]) if used in inside))
        knows_later = any(condition in later for product in part for condition, _ in product)
        if knows_later and node.args:  # not what a branch hands out
            late.append((node, part))
        else:
            at_once = either(at_once, part)
    if (
        at_once == NEVER
        or not late
        or implies(without(either(at_once, *(part for _, part in late)), later), at_once)
    ):
        return []
    graph.forget(inside)  # or the copy would be the same nodes
    copies = replayed(graph, inside, {})
    for node, _ in late:
        node.args = tuple(copies.get(a, a) for a in node.args)
    graph.forget(node for node, _ in late)
    return [copies[n] for n in inside]


def alone(latch: Node, nodes: Iterable[Node]) -> tuple[set[Node], set[Node]]:
    """What varies in the latch's loop by the latch alone, and what of it needs what is costly."""
    by_latch: set[Node] = set()
    costly: set[Node] = set()
    for node in nodes:
        varying = {a for a in node.args if a.scope is latch.scope}
        if node.scope is latch.scope and varying and varying <= {latch, *by_latch}:
            by_latch.add(node)
            if cost(node) >= COSTLY or not costly.isdisjoint(varying):
                costly.add(node)
    return by_latch, costly


def with_feeders(costly: Collection[Node], latch: Node, nodes: Sequence[Node]) -> list[Node]:
    """The costly nodes and what in the latch's loop they alone need."""
    inside, users = set(costly), users_of(nodes)
    for node in reversed(nodes):  # users first
        feeds = users[node] and users[node].issubset(inside)
        if feeds and node.scope is latch.scope and node.args and node is not latch:
            inside.add(node)
    return [n for n in nodes if n in inside]


def carried(graph: Graph, loop: Loop, init: Node) -> Node:
    """A new value that a loop hands from turn to turn; what it becomes is still to be set."""
    phi = graph.place("phi", init.kind, len(loop.phis), uniform=False, scope=loop, of=loop)
    loop.inits.append(init)
    loop.phis.append(phi)
    loop.outs.append(phi)
    return phi


def replayed(graph: Graph, nodes: Iterable[Node], instead: dict[Node, Node]) -> dict[Node, Node]:
    """The same operations, on other operands where there are some `instead`."""
    known = dict(instead)
    for node in nodes:
        args = [known.get(a, a) for a in node.args]
        known[node] = graph.node(node.op, args, node.kind, node.value)
    return known
