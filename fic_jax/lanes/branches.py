"""Coherent branches: a vector skips the rare arm of a `where_rare` if no lane needs it."""

from collections.abc import Sequence

from fic_jax.lanes.graph import Branch, Graph, Node, Scope, live, users_of

Users = dict[Node, set[Node]]
LEAST_BLENDS = 4  # that are worth a branch


def branch_out(graph: Graph, roots: list[Node]) -> None:
    """Move the nodes that only a rare arm uses into a branch, outer hints first.

    The select moves too: in the branch it chooses for each lane. If no lane meets the condition,
    the results are the other arm. So the bits do not depend on the neighbours.
    """
    nodes = live(roots)
    users = users_of(nodes)
    selects: dict[int, list[Node]] = {}
    for node in nodes:
        if node.op == "select_n" and node.value is not None:
            selects.setdefault(node.value, []).append(node)
    for _, hinted in sorted(selects.items()):
        # an arm may itself be a select, on another condition
        groups: dict[tuple[Scope | None, Node], list[Node]] = {}
        for select in hinted:
            groups.setdefault((select.scope, select.args[0]), []).append(select)
        for (scope, _), group in groups.items():
            if still := [n for n in group if n.scope is scope and (users[n] or n in roots)]:
                _into_branch(graph, still, roots, users)


def _into_branch(graph: Graph, selects: list[Node], roots: list[Node], users: Users) -> None:
    """Put selects on one condition, and the nodes that only their rare arm uses, into a branch."""
    scope, condition = selects[0].scope, selects[0].args[0]
    inside = _only_for(selects, set(roots), users)
    blends = len(inside) == len(selects) < LEAST_BLENDS
    if blends and not condition.uniform:  # they cost less than a jump
        return
    branch = Branch(scope, selects, condition=condition, otherwise=[n.args[1] for n in selects])
    for node in inside:
        node.scope = branch
    if not set(selects) & set(roots):
        branch.condition = _where_used(graph, branch, users)
    for i, select in enumerate(selects):
        result = graph.place("result", select.kind, i, uniform=False, scope=scope, of=branch)
        users[result] = users[select] - inside.keys()
        users[select] = (users[select] & inside.keys()) | {result}
        for used in result.uses():
            users[used].add(result)
        for user in users[result]:
            user.replace({select: result})
        roots[:] = [result if root is select else root for root in roots]


def _only_for(selects: Sequence[Node], roots: set[Node], users: Users) -> dict[Node, None]:
    """The selects, and the nodes of their scope that nothing but their rare arms uses."""
    scope, inside = selects[0].scope, dict.fromkeys(selects)
    waiting = list(selects)
    while waiting:
        for node in waiting.pop().args:
            if node in inside or node.scope is not scope or not node.args or node in roots:
                continue
            if all(u in inside and _for_rare_arm(node, u, selects) for u in users[node]):
                inside[node] = None
                waiting.append(node)
    return inside


def _where_used(graph: Graph, branch: Branch, users: Users) -> Node:
    """The path predicate: the condition, and that of the selects that alone use these, if any."""
    wanted = {_wanted(select, branch.outer, users) for select in branch.outs}
    if len(wanted) != 1 or None in wanted:
        return branch.condition
    needed, yes = wanted.pop()  # type: ignore[misc]
    if not yes:
        needed = _combined(graph, "not", (needed,), users)
    return _combined(graph, "and", (branch.condition, needed), users)


def _wanted(select: Node, scope: Scope | None, users: Users) -> tuple[Node, bool] | None:
    """The condition under which another select, the only user, chooses this one, and its value."""
    user, *others = users[select]
    chooses = user.op == "select_n" and user.args.count(select) == 1 and user.args[0] is not select
    if others or not chooses or user.scope is not scope:
        return None
    return user.args[0], user.args[2] is select


def _combined(graph: Graph, op: str, args: tuple[Node, ...], users: Users) -> Node:
    node = graph.node(op, args, "b")
    users.setdefault(node, set())
    for arg in args:
        users[arg].add(node)
    return node


def _for_rare_arm(node: Node, user: Node, selects: Sequence[Node]) -> bool:
    """Whether a node is no condition and no other arm of these selects."""
    return user not in selects or node not in user.args[:2]
