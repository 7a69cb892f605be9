"""What the turns of a loop leave to each other."""

from collections.abc import Iterable, Sequence

from fic_jax.lanes.graph import Graph, Node, live, loops
from fic_jax.lanes.moves import substitute


def recall(graph: Graph, roots: Sequence[Node]) -> None:
    """Take from the last turn what it has left, where a turn would begin by computing it again.

    A node of a turn that is f(phis) equals phi i in every turn, if phi i starts as f(inits) and
    its out is f(outs): by induction over the turns.
    """
    for loop in loops(roots):
        nodes = [n for n in live(roots) if n.scope is loop]
        again = _known(graph, nodes, dict(zip(loop.outs, loop.phis, strict=True)))
        at_first = _known(graph, nodes, dict(zip(loop.phis, loop.inits, strict=True)))
        instead = {}
        for phi, out, init in zip(loop.phis, loop.outs, loop.inits, strict=True):
            node = again.get(out)
            if node and at_first.get(node) is init:
                instead[node] = phi
        substitute(live(roots), instead)


def _known(
    graph: Graph, nodes: Iterable[Node], instead: dict[Node, Node]
) -> dict[Node, Node | None]:
    """For each of the nodes, in their order, the same operation with others `instead`, if there."""
    found: dict[Node, Node | None] = {}
    for node in nodes:
        args = [instead[a] if a in instead else found.get(a, a) for a in node.args]
        there = [a for a in args if a]
        whole = bool(args) and len(there) == len(args)
        found[node] = graph.known(node.op, there, node.kind, node.value) if whole else None
    return found
