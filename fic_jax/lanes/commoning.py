"""Predictive commoning: an iteration reuses a value that the last iteration has computed."""

from collections.abc import Iterable, Sequence

from fic_jax.lanes.graph import Graph, Node, live, loops, replace


def common(graph: Graph, roots: Sequence[Node]) -> None:
    """Replace a node by a loop-carried value that always equals it.

    A node f(phis) of an iteration equals phi i in every iteration, if phi i starts as f(inits) and
    its out is f(outs): by induction over the iterations.
    """
    for loop in loops(roots):
        nodes = [n for n in live(roots) if n.scope is loop]
        of_outs = _same_operation(graph, nodes, dict(zip(loop.outs, loop.phis, strict=True)))
        of_inits = _same_operation(graph, nodes, dict(zip(loop.phis, loop.inits, strict=True)))
        equal = {}
        for phi, out, init in zip(loop.phis, loop.outs, loop.inits, strict=True):
            node = of_outs.get(out)
            if node and of_inits.get(node) is init:
                equal[node] = phi
        replace(live(roots), equal)


def _same_operation(
    graph: Graph, nodes: Iterable[Node], instead: dict[Node, Node]
) -> dict[Node, Node | None]:
    """For each node: the existing node of its operation on the operands `instead`, or None."""
    same: dict[Node, Node | None] = {}
    for node in nodes:
        args = [instead[a] if a in instead else same.get(a, a) for a in node.args]
        known = [a for a in args if a]
        complete = bool(args) and len(known) == len(args)
        same[node] = graph.known(node.op, known, node.kind, node.value) if complete else None
    return same
