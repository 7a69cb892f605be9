"""What of a graph is worth jumping over, and when: the same bits, less work.

Physics is written without branches, so that it can be batched and differentiated: both arms of a
`where` are always computed. A kernel for a vector of scenarios can test what any of them needs:

- what is costly and depends on nothing but a latched value, one that a `where` may keep from turn
  to turn, is computed after that has changed, and kept;
- what is costly and used behind a `where` alone is computed where that takes it.
"""

from collections.abc import Collection, Iterable, Sequence

from fic_jax.native.demands import (
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
from fic_jax.native.graph import Branch, Graph, Loop, Node, Scope, live

# Instructions, about; what isn't here is one.
COST = {"exp": 16, "sqrt": 6, "div": 6, "constant": 0, "phi": 0, "result": 0}
COSTLY = 16  # what a branch has to save if that is one operation (an exponential)
BULK = 40  # or many: less is not worth a mispredicted jump
ZERO = {"f": 0.0, "i": 0, "b": False}

Users = dict[Node, set[Node]]


def branch_out(graph: Graph, roots: Sequence[Node]) -> None:
    """Put what is costly behind the conditions under which it is needed."""
    everything = live(roots)
    for node in everything:
        if node.op == "select_n" and any(a.op == "phi" for a in node.args[1:]) and not node.uniform:
            everything = keep(graph, node, everything, roots)
    for loop in dict.fromkeys(node.of for node in live(roots) if isinstance(node.of, Loop)):
        while jump_over(graph, loop, roots):
            pass


def keep(graph: Graph, latch: Node, everything: list[Node], roots: Sequence[Node]) -> list[Node]:
    """Compute what is costly and depends on `latch` alone when that has changed, not before.

    `everything`, and what is returned, are the live nodes.
    """
    loop, costly = latch.scope, alone(latch, everything)
    if not (costly and isinstance(loop, Loop)):
        return everything
    inside = with_feeders(costly, latch, everything)
    while inside:
        inside = _keep(graph, latch, inside, loop, roots)
    return live(roots)


def _keep(
    graph: Graph, latch: Node, inside: list[Node], loop: Loop, roots: Sequence[Node]
) -> list[Node]:
    """`keep` for these nodes; returns those that have to be kept apart from them."""
    everything = live(roots)
    users = users_of(everything)
    nodes, wanted = demands(everything, loop)
    outs = [n for n in inside if not users[n].issubset(inside)]
    demand = without(either(*(wanted[n] for n in outs)), dependants(inside, nodes))
    apart = parted(graph, inside, everything, loop) if demand == ALWAYS else []
    if apart:
        alive = set(live(roots))
        return _keep(graph, latch, [n for n in inside if n in alive], loop, roots) or apart
    # What is kept at first is right for a latch of 0.
    zero = graph.constant(ZERO[latch.kind], latch.kind)
    key, firsts = carried(graph, loop, zero), replayed(graph, inside, {latch: zero})
    kept = [key, *(carried(graph, loop, firsts[n]) for n in outs)]
    changed = graph.node("differs", (latch, key), "b")
    if demand != ALWAYS:
        changed = graph.node("and", (met(graph, demand), changed), "b")
    same = graph.node("copy", (latch,), latch.kind)
    branch = Branch(loop, [same, *outs], condition=changed, otherwise=list(kept))
    for phi, result in zip(kept, move(graph, [*inside, same], branch, everything), strict=True):
        loop.outs[phi.value] = result
    return []


def parted(
    graph: Graph, inside: Sequence[Node], everything: Sequence[Node], loop: Loop
) -> list[Node]:
    """A copy of some nodes for those users who want them under conditions known later.

    Conditions that themselves need the nodes can't tell when to compute them. Where that makes
    them needed more often than without such users, these get nodes of their own. The copy is empty
    where that gains nothing.
    """
    nodes, wanted = demands(everything, loop)
    later = dependants(inside, nodes)
    at_once, late = NEVER, []
    for node in nodes:
        if node in inside:
            continue
        part = either(NEVER, *(d for used, d in uses(node, wanted[node]) if used in inside))
        if any(condition in later for product in part for condition, _ in product):
            late.append((node, part))
        else:
            at_once = either(at_once, part)
    if at_once == NEVER or implies(
        without(either(at_once, *(part for _, part in late)), later), at_once
    ):
        return []
    graph.forget(inside)  # or the copy would be the same nodes
    copies = replayed(graph, inside, {})
    for node, _ in late:
        node.args = tuple(copies.get(a, a) for a in node.args)
    graph.forget(node for node, _ in late)
    return [copies[n] for n in inside]


def alone(latch: Node, nodes: Iterable[Node]) -> set[Node]:
    """What varies in the latch's loop by the latch alone and is costly, or needs what is."""
    by_latch: set[Node] = {latch}
    costly: set[Node] = set()
    for node in nodes:
        varying = [a for a in node.args if a.scope is latch.scope]
        if node.scope is latch.scope and varying and by_latch.issuperset(varying):
            by_latch.add(node)
            if cost(node) >= COSTLY or not costly.isdisjoint(varying):
                costly.add(node)
    return costly


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


def jump_over(graph: Graph, loop: Loop, roots: Sequence[Node]) -> bool:
    """Move the costliest nodes of one demand in a loop into a branch, if there are any left."""
    everything = live(roots)
    nodes, wanted = demands(everything, loop)
    for scope, demand, own in candidates(nodes, wanted):
        there = [n for n in nodes if n.scope is scope]
        hidden = {n for n in nodes if not visible(n, scope)}
        inside = convex([n for n in there if implies(wanted[n], demand)], nodes)
        known = without(demand, hidden | dependants(inside, nodes))
        if known != demand:  # others are better off with what is known of their own demand
            inside = convex([n for n in there if wanted[n] in own], nodes)
            known = without(demand, hidden | dependants(inside, nodes))
        if implies(met_in(scope), known):
            continue
        condition = met(graph, known)
        first = ancestors(condition)
        inside = [n for n in inside if n not in first]
        if sum(map(cost, inside)) < COSTLY:
            continue
        users = users_of(everything)
        outs = [n for n in inside if not users[n].issubset(inside)]
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


def visible(node: Node, scope: Scope | None) -> bool:
    """Whether a node is computed in a scope or around it."""
    while scope and scope is not node.scope:
        scope = scope.outer
    return scope is node.scope


def met_in(scope: Scope | None) -> Demand:
    """What some scenario meets, wherever a scope is computed."""
    return scope.demand if isinstance(scope, Branch) else ALWAYS


def move(graph: Graph, inside: Iterable[Node], branch: Branch, nodes: Iterable[Node]) -> list[Node]:
    """Put nodes into a branch; whoever of the live `nodes` uses its `outs` takes its results."""
    results = [
        graph.place("result", out.kind, i, uniform=False, scope=branch.outer, of=branch)
        for i, out in enumerate(branch.outs)
    ]
    instead = dict(zip(branch.outs, results, strict=True))
    gone = set(inside)
    for node in nodes:
        if node not in gone and not instead.keys().isdisjoint(node.args):
            node.args = tuple(instead.get(a, a) for a in node.args)
    for scope in dict.fromkeys(node.of for node in nodes if node.of):
        scope.replace(instead)
    for node in gone:
        node.scope = branch
    graph.forget(gone)
    return results


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
