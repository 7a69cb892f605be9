"""Coherent branches: a vector skips the rare arm of a `where_rare` if no lane needs it."""

from collections.abc import Sequence

from fic_jax.lanes.graph import Branch, Graph, Node, Scope, live, replace, users_of


def branch_out(graph: Graph, roots: list[Node]) -> None:
    """Move the nodes that only a rare arm uses into a branch, outer hints first.

    The select moves too: in the branch it chooses for each lane. If no lane meets the condition,
    the results are the other arm. So the bits do not depend on the neighbours.
    """
    hints = sorted({n.value for n in live(roots) if n.op == "select_n" and n.value is not None})
    for hint in hints:
        selects = [n for n in live(roots) if n.op == "select_n" and n.value == hint]
        groups: dict[tuple[Scope | None, Node], list[Node]] = {}
        for select in selects:  # an arm may itself be a select, on another condition
            groups.setdefault((select.scope, select.args[0]), []).append(select)
        for (scope, _), group in groups.items():
            alive = live(roots)
            if still := [n for n in group if n.scope is scope and n in alive]:
                _into_branch(graph, still, roots)


def _into_branch(graph: Graph, selects: Sequence[Node], roots: list[Node]) -> None:
    """Put selects on one condition, and the nodes that only their rare arm uses, into a branch."""
    everything, scope = live(roots), selects[0].scope
    users = users_of(everything)
    inside = dict.fromkeys(selects)
    for node in reversed(everything):  # users first
        movable = node.scope is scope and node.args and node not in roots
        if movable and all(u in inside and _for_rare_arm(node, u, selects) for u in users[node]):
            inside[node] = None
    condition = selects[0].args[0]
    if len(inside) == len(selects) and not condition.uniform:  # a few blends cost less than a jump
        return
    graph.forget(inside)  # the condition of the branch can't lie inside it
    if len(selects) == 1 and selects[0] not in roots:
        condition = _where_used(graph, condition, selects[0], users[selects[0]])
    branch = Branch(
        scope, list(selects), condition=condition, otherwise=[n.args[1] for n in selects]
    )
    results = [
        graph.place("result", n.kind, i, uniform=False, scope=scope, of=branch)
        for i, n in enumerate(selects)
    ]
    instead = dict(zip(selects, results, strict=True))
    replace(everything, instead, but=inside)
    roots[:] = [instead.get(root, root) for root in roots]
    for node in inside:
        node.scope = branch


def _where_used(graph: Graph, condition: Node, select: Node, users: set[Node]) -> Node:
    """The path predicate: the condition, and that of the only select that uses this one, if any."""
    user = users.pop()
    chooses = user.op == "select_n" and user.args.count(select) == 1 and user.args[0] is not select
    if users or not chooses or user.scope is not select.scope:
        return condition
    needed, no, _ = user.args
    if no is select:
        needed = graph.node("not", (needed,), "b")
    return graph.node("and", (condition, needed), "b")


def _for_rare_arm(node: Node, user: Node, selects: Sequence[Node]) -> bool:
    """Whether a node is no condition and no other arm of these selects."""
    return user not in selects or node not in user.args[:2]
