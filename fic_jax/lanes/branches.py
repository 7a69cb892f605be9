"""What of a graph is worth jumping over, and when: the same bits, less work.

Physics is written without branches, so that it can be batched and differentiated: both arms of a
`where` are always computed. A kernel for a vector of scenarios can test what any of them needs:

- what is costly and depends on nothing but a latched value, one that a `where` may keep from turn
  to turn, is computed after that has changed, and kept;
- what is costly and used behind a `where` alone is computed where that takes it.
"""

from collections.abc import Sequence
from typing import Any

from fic_jax.lanes.demands import ALWAYS, NEVER, Demand, demands, implies, met, without
from fic_jax.lanes.graph import ZERO, Branch, Graph, Loop, Node, Scope, live, loops
from fic_jax.lanes.latched import keep, parted
from fic_jax.lanes.moves import (
    BULK,
    COSTLY,
    ancestors,
    convex,
    cost,
    dependants,
    move,
    outs_of,
    substitute,
    visible,
)


def branch_out(graph: Graph, roots: Sequence[Node]) -> None:
    """Put what is costly behind the conditions under which it is needed."""
    everything = live(roots)
    for node in everything:
        if node.op == "select_n" and any(a.op == "phi" for a in node.args[1:]) and not node.uniform:
            everything = keep(graph, node, everything, roots)
    for loop in loops(roots):
        apart: set[Node] = set()
        while jump_over(graph, loop, roots, apart):
            pass
    merge(roots)


def merge(roots: Sequence[Node]) -> None:
    """Compute once what the conditions of branches have in common, with each other or the law."""
    known: dict[Any, Node] = {}
    instead: dict[Node, Node] = {}
    for node in live(roots):
        args = [instead.get(a, a).id for a in node.args]
        if args:
            key = (node.op, *args, node.kind, repr(node.value), id(node.scope))
            same = known.setdefault(key, node)
            if same is not node:
                instead[node] = same
    substitute(live(roots), instead)


def jump_over(graph: Graph, loop: Loop, roots: Sequence[Node], apart: set[Node]) -> bool:
    """Move the costliest nodes of one demand in a loop into a branch, if there are any left.

    What users want under conditions known later is copied for them, but once: then it is `apart`.
    """
    everything = live(roots)
    nodes, wanted = demands(everything, loop)
    for scope, demand, own in candidates(nodes, wanted):
        there = [n for n in nodes if n.scope is scope]
        hidden = {n for n in nodes if not visible(n, scope)}
        takes = [n for n in there if implies(wanted[n], demand)]
        inside = convex(takes, everything)
        known = without(demand, hidden | dependants(inside, everything))
        if known != demand:  # others are better off with what is known of their own demand
            takes = [n for n in there if wanted[n] in own]
            inside = convex(takes, everything)
            known = without(demand, hidden | dependants(inside, everything))
        costly = any(cost(n) >= COSTLY for n in inside)
        if known != demand and costly and apart.isdisjoint(inside):
            copies = parted(graph, inside, everything, loop)
            apart.update(inside, copies)
            if copies:
                return True
        if implies(met_in(scope), known):
            continue
        condition = met(graph, known)
        first = ancestors(condition)  # what other conditions are made of would keep its users out
        inside = convex([n for n in takes if n not in first], everything)
        if sum(map(cost, inside)) < COSTLY:
            continue
        outs = outs_of(inside, everything)
        zeros = [graph.constant(ZERO[n.kind], n.kind) for n in outs]
        branch = Branch(scope, outs, condition=condition, otherwise=zeros, demand=known)
        move(graph, inside, branch, everything)
        return True
    return False


def candidates(
    nodes: Sequence[Node], wanted: dict[Node, Demand]
) -> list[tuple[Scope, Demand, list[Demand]]]:
    """Demands worth a branch, the costliest first, each with those within that it is for.

    One within another is worth a branch of its own if what it saves is, or if one operation is.
    """
    costs: dict[Scope, dict[Demand, int]] = {}
    dear: set[Demand] = set()
    for node in nodes:
        if node.scope and not node.uniform and wanted[node] not in (ALWAYS, NEVER):
            of_scope = costs.setdefault(node.scope, {})
            of_scope[wanted[node]] = of_scope.get(wanted[node], 0) + cost(node)
            if cost(node) >= COSTLY:
                dear.add(wanted[node])
    found: list[tuple[int, int, Scope, Demand, list[Demand]]] = []
    for scope, there in costs.items():
        within = {d: [other for other in there if implies(other, d)] for d in there}
        whole = {d: sum(there[other] for other in within[d]) for d in there}
        claimed: set[Demand] = set()
        for demand in sorted(there, key=lambda d: whole[d]):
            own = [d for d in within[demand] if d not in claimed]
            least = BULK if dear.isdisjoint(own) else COSTLY
            if sum(there[d] for d in own) >= least and not implies(met_in(scope), demand):
                claimed.update(own)
                found.append((-whole[demand], len(found), scope, demand, own))
    return [(scope, d, own) for _, _, scope, d, own in sorted(found, key=lambda f: f[:2])]


def met_in(scope: Scope | None) -> Demand:
    """What some scenario meets, wherever a scope is computed."""
    return scope.demand if isinstance(scope, Branch) else ALWAYS
