"""Where a product and a sum are rounded once."""

from collections.abc import Iterable

from fic_jax.lanes.graph import Graph, Node, live


def fuse(graph: Graph, roots: Iterable[Node]) -> None:
    """Make a product and the sum it is only used in one rounding, where the processor can.

    Told here, and not left to the compiler: whether it sees both would depend on the branches.
    """
    nodes = live(roots)
    uses = dict.fromkeys(roots, 1)
    steps: dict[Node, int] = {}  # operations that have to come before
    for node in nodes:
        steps[node] = 1 + max((steps[a] for a in node.before() if a in steps), default=0)
        for used in (*node.args, *(node.of.makes(node.value) if node.of else ())):
            uses[used] = uses.get(used, 0) + 1
    for node in nodes:
        if node.op not in ("add", "sub") or node.kind != "f":
            continue
        products = [
            (steps[a], i)
            for i, a in enumerate(node.args)
            if uses[a] == 1 and a.scope is node.scope and _factors(a)
        ]
        if products:
            _, i = max(products)  # the one that is there last
            signs = {"add": "+ +", "sub": ("+ -", "- +")[i]}[node.op]
            graph.forget([node])
            node.op, node.value = "fma", signs
            node.args = (*_factors(node.args[i]), node.args[1 - i])


def _factors(node: Node) -> tuple[Node, ...]:
    square = node.op == "square" or (node.op == "integer_pow" and node.value == 2)
    return node.args if node.op == "mul" else 2 * node.args if square else ()
