"""FMA contraction: a product and the only sum that uses it become one operation, rounded once."""

from collections.abc import Iterable

from fic_jax.lanes.graph import Graph, Node, live


def contract(graph: Graph, roots: Iterable[Node]) -> None:
    """Replace a product and the only sum that uses it by one fused multiply-add.

    LLVM could contract too, but only within one basic block: the bits would depend on the branches.
    Processors without the instruction multiply and add.
    """
    nodes = live(roots)
    n_uses = dict.fromkeys(roots, 1)
    steps: dict[Node, int] = {}  # operations on a node's longest path
    for node in nodes:
        steps[node] = 1 + max((steps[a] for a in node.before() if a in steps), default=0)
        for used in node.uses():
            n_uses[used] = n_uses.get(used, 0) + 1
    fused = []
    for node in nodes:
        if node.op not in ("add", "sub") or node.kind != "f":
            continue
        products = [
            (steps[a], i)
            for i, a in enumerate(node.args)
            if n_uses[a] == 1 and a.scope is node.scope and _factors(a)
        ]
        if products:
            _, i = max(products)  # the one that is computed last
            signs = {"add": "+ +", "sub": ("+ -", "- +")[i]}[node.op]
            fused.append(node)
            node.op, node.value = "fma", signs
            node.args = (*_factors(node.args[i]), node.args[1 - i])
    graph.forget(fused)


def _factors(node: Node) -> tuple[Node, ...]:
    square = node.op == "square" or (node.op == "integer_pow" and node.value == 2)
    return node.args if node.op == "mul" else 2 * node.args if square else ()
