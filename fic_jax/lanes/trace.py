"""Trace: JAX traces a scalar function to a jaxpr; its calls are inlined into one graph."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from fic_jax.lanes.graph import Graph, Loop, Node, Scope, Untranslatable
from fic_jax.lanes.hints import RARE

SAME = ("copy", "copy_p", "stop_gradient")  # primitives that change no number
SYNONYMS = {"add_any": "add"}  # in gradients
CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")


def traced(
    function: Callable[..., Any], types: Sequence[Any], uniform: Sequence[bool], dtype: np.dtype
) -> tuple[Graph, list[Node]]:
    """Graph and results of a function of scalars of these types; floats are of one `dtype`.

    Input i has its index among the uniform arguments, or among the others (columns), as its value.

    Raises Untranslatable.
    """
    jaxpr = jax.make_jaxpr(function)(*types)
    for out in jaxpr.jaxpr.outvars:
        kind_of(out.aval.dtype, dtype)
    graph = Graph(dtype)
    inputs = [
        graph.place("input", kind_of(t.dtype, dtype), uniform[:i].count(same), uniform=same)
        for i, (t, same) in enumerate(zip(types, uniform, strict=True))
    ]
    return graph, inlined(graph, jaxpr, inputs, None)


def inlined(graph: Graph, jaxpr: Any, args: Sequence[Node], scope: Scope | None) -> list[Node]:
    """The nodes of a closed jaxpr's results."""
    inner = jaxpr.jaxpr
    nodes = dict(zip(inner.invars, args, strict=True))

    def read(atom: Any) -> Node:
        literal = hasattr(atom, "val")
        return graph.constant(atom.val, atom.aval.dtype.kind) if literal else nodes[atom]

    for var, value in zip(inner.constvars, jaxpr.consts, strict=True):
        nodes[var] = graph.constant(value, kind_of(var.aval.dtype, graph.dtype))

    for eqn in inner.eqns:
        operands = [read(a) for a in eqn.invars]
        nodes |= zip(eqn.outvars, translated(graph, eqn, operands, scope), strict=True)
    return [read(a) for a in inner.outvars]


def translated(graph: Graph, eqn: Any, args: list[Node], scope: Scope | None) -> list[Node]:
    """The nodes of one equation's results."""
    name, params = SYNONYMS.get(eqn.primitive.name, eqn.primitive.name), eqn.params
    if name in SAME:
        return args
    if name in CALLS:
        hint = next(graph.ids)  # outer hints have smaller numbers
        outs = inlined(graph, params.get("jaxpr") or params["call_jaxpr"], args, scope)
        return [hinted(graph, n, hint) for n in outs] if params.get("name") == RARE else outs
    if name == "while":
        return repeated(graph, eqn, args, scope)
    if name == "scan":
        return looped(graph, eqn, args, scope)
    by_index = name == "select_n" and (len(args) > 3 or args[0].kind != "b")
    if len(eqn.outvars) != 1 or by_index:
        raise Untranslatable(f"the operation {name} with {len(args)} operands")
    return [_operation(graph, name, eqn, args)]


def _operation(graph: Graph, name: str, eqn: Any, args: list[Node]) -> Node:
    """The node of an operation with one result."""
    if name == "select_n" and args[1] is args[2]:
        return args[1]
    kind = kind_of(eqn.outvars[0].aval.dtype, graph.dtype)
    if name == "convert_element_type":
        return args[0] if args[0].kind == kind else graph.node("convert", args, kind)
    return graph.node(name, args, kind, eqn.params.get("y"))


def hinted(graph: Graph, node: Node, hint: int) -> Node:
    """The select at the end of a `where_rare`, marked with the number of this hint."""
    if node.op != "select_n" or node.uniform:  # a constant condition left no select
        return node
    return graph.node(node.op, node.args, node.kind, hint)


def looped(graph: Graph, eqn: Any, args: list[Node], outer: Scope | None) -> list[Node]:
    """The results of a `fori_loop` or `scan` of known length without arrays."""
    params = eqn.params
    if any(atom.aval.ndim for atom in (*eqn.invars, *eqn.outvars)):
        raise Untranslatable("a scan over arrays")
    if not 0 < params["length"] < 2**31:
        raise Untranslatable(f"a loop of {params['length']} iterations")
    # without arrays, all outputs are carried; how JAX stores the number of constants has changed
    n_consts = len(args) - len(eqn.outvars)
    consts, inits = args[:n_consts], args[n_consts:]

    def write(loop: Loop) -> None:
        loop.length = params["length"]
        loop.outs = inlined(graph, params["jaxpr"], [*consts, *loop.phis], loop)

    return _results(graph, inits, outer, write)


def repeated(graph: Graph, eqn: Any, args: list[Node], outer: Scope | None) -> list[Node]:
    """The results of a `while_loop` without arrays: a lane that has finished keeps its numbers."""
    params = eqn.params
    if any(atom.aval.ndim for atom in (*eqn.invars, *eqn.outvars)):
        raise Untranslatable("a while loop over arrays")
    n, m = params["cond_nconsts"], params["body_nconsts"]
    of_condition, of_body, inits = args[:n], args[n : n + m], args[n + m :]

    def goes_on(values: Sequence[Node], loop: Loop) -> Node:
        (node,) = inlined(graph, params["cond_jaxpr"], [*of_condition, *values], loop)
        return node

    def write(loop: Loop) -> None:
        computed = inlined(graph, params["body_jaxpr"], [*of_body, *loop.phis], loop)
        runs = goes_on(loop.phis, loop)
        loop.outs = [
            graph.node("select_n", (runs, phi, out), phi.kind)
            for phi, out in zip(loop.phis, computed, strict=True)
        ]
        loop.goes_on = goes_on(loop.outs, loop)

    return _results(graph, inits, outer, write)


def _results(
    graph: Graph, inits: Sequence[Node], outer: Scope | None, write: Callable[[Loop], None]
) -> list[Node]:
    """The results of a loop whose iteration `write` writes from its phis."""
    assumed: list[bool] | None = None
    uniform = [init.uniform for init in inits]
    while uniform != assumed:  # a carried value is uniform if it is so after an iteration too
        assumed, loop = uniform, Loop(outer, inits=list(inits))
        loop.phis = [
            graph.place("phi", init.kind, i, uniform=same, scope=loop, of=loop)
            for i, (init, same) in enumerate(zip(inits, assumed, strict=True))
        ]
        write(loop)
        uniform = [u and out.uniform for u, out in zip(assumed, loop.outs, strict=True)]
    return [
        graph.place("result", phi.kind, i, uniform=phi.uniform, scope=outer, of=loop)
        for i, phi in enumerate(loop.phis)
    ]


def kind_of(dtype: np.dtype, real: np.dtype) -> str:
    """f, i or b. All have the width of the floats: integers are counts below 2^31."""
    if dtype not in (real, np.int32, np.int64, np.bool_):
        raise Untranslatable(f"{dtype} among {real}")
    return str(np.dtype(dtype).kind)
