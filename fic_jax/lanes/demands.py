"""When a node of a graph is looked at: a sum of products of conditions that hold or not.

Behind a `where`, a value is only needed where that takes it. A demand is the set of its products,
each the set of its conditions; the empty product is always met.
"""

from collections.abc import Collection, Iterable

from fic_jax.lanes.graph import Branch, Graph, Loop, Node

Demand = frozenset[frozenset[tuple[Node, bool]]]

ALWAYS: Demand = frozenset([frozenset()])
NEVER: Demand = frozenset()
TERMS = 8  # a longer sum costs more to test than a branch saves


def demands(everything: Iterable[Node], loop: Loop) -> tuple[list[Node], dict[Node, Demand]]:
    """The live nodes of a loop's turn, and the demand of each: what its users there do with it."""
    nodes = [node for node in everything if turn(node) is loop]
    wanted = dict.fromkeys(nodes, NEVER)
    for node in everything:
        if turn(node) is not loop or isinstance(node.of, Loop):
            made = node.of.makes(node.value) if node.of else ()
            wanted |= dict.fromkeys(wanted.keys() & {*node.args, *made}, ALWAYS)
    for node in reversed(nodes):
        for used, part in uses(node, wanted[node]):
            if used in wanted:
                wanted[used] = either(wanted[used], part)
    return nodes, wanted


def uses(node: Node, wanted: Demand) -> list[tuple[Node, Demand]]:
    """What a node looks at, and when, if it is wanted no more often than told."""
    if isinstance(node.of, Branch):
        return [(made, wanted) for made in node.of.makes(node.value)]
    if node.op != "select_n":
        return [(arg, wanted) for arg in node.args]
    condition, no, yes = node.args
    taken = [(no, when(condition, False)), (yes, when(condition, True))]
    return [(condition, wanted), *((arg, both(wanted, taking)) for arg, taking in taken)]


def turn(node: Node) -> Loop | None:
    """The innermost loop around a node."""
    scope = node.scope
    while isinstance(scope, Branch):
        scope = scope.outer
    assert scope is None or isinstance(scope, Loop)
    return scope


def when(node: Node, holds: bool) -> Demand:
    """A condition as a demand."""
    if node.op == "not":
        return when(node.args[0], not holds)
    if node.op in ("and", "or") and node.kind == "b":
        parts = [when(arg, holds) for arg in node.args]
        return both(*parts) if (node.op == "and") is holds else either(*parts)
    return frozenset([frozenset([(node, holds)])])


def either(*demands: Demand) -> Demand:
    """The sum."""
    terms: Demand = frozenset().union(*demands)
    return terms if terms in demands else simplified(terms)


def both(a: Demand, b: Demand) -> Demand:
    """The product."""
    pairs = (p | q for p in a for q in b)
    return simplified(p for p in pairs if not any((node, not holds) in p for node, holds in p))


def simplified(products: Iterable[frozenset[tuple[Node, bool]]]) -> Demand:
    """A sum with as few terms as a or ab = a and ab or a(not b) = a allow."""
    terms = frozenset(products)
    shorter = frozenset() not in terms
    while shorter:
        shorter = False
        for term in sorted(terms, key=_by_id):  # what comes out is the same in every process
            for node, holds in sorted(term, key=_literal):
                rest = term - {(node, holds)}
                if any(other <= rest | {(node, not holds)} for other in terms):
                    terms = terms - {term} | {rest}
                    shorter = True
                    break
            if shorter:
                break
    least = frozenset(a for a in terms if not any(b < a for b in terms))
    return least if len(least) <= TERMS else ALWAYS


def _literal(condition: tuple[Node, bool]) -> tuple[int, bool]:
    return condition[0].id, condition[1]


def _by_id(product: frozenset[tuple[Node, bool]]) -> list[tuple[int, bool]]:
    return sorted(map(_literal, product))


def implies(a: Demand, b: Demand) -> bool:
    """Whether b is met wherever a is, as far as the terms tell."""
    return all(any(q <= p for q in b) for p in a)


def without(demand: Demand, unknown: Collection[Node]) -> Demand:
    """What a demand is at most, where some conditions are not known."""
    return simplified(frozenset(c for c in p if c[0] not in unknown) for p in demand)


def met(graph: Graph, demand: Demand) -> Node:
    """Whether a demand is met, as a node."""

    def joined(op: str, nodes: list[Node]) -> Node:
        first, *others = nodes
        for other in others:
            first = graph.node(op, (first, other), "b")
        return first

    products = []
    for product in sorted(demand, key=_by_id):
        literals = [
            node if holds else graph.node("not", (node,), "b")
            for node, holds in sorted(product, key=_literal)
        ]
        products.append(joined("and", literals))
    return joined("or", products)
