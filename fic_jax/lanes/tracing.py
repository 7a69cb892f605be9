"""From a function that JAX traces to the graph of its operations: calls are inlined."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from fic_jax.lanes.graph import Graph, Loop, Node, Scope, Untranslatable

SAME = ("copy", "copy_p", "stop_gradient")  # primitives that change no number
CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")


def traced(run: Callable[..., Any], n: int, dtype: np.dtype) -> tuple[Graph, list[Node]]:
    """Graph and results of `run(column, dt)` for one scenario of n quantities.

    Raises Untranslatable.
    """
    scalar = jax.ShapeDtypeStruct((), dtype)
    jaxpr = jax.make_jaxpr(run)([scalar] * n, scalar)
    graph = Graph(dtype)
    inputs = [graph.place("input", "f", i, uniform=i == n) for i in range(n + 1)]
    return graph, inlined(graph, jaxpr, inputs, None)


def inlined(graph: Graph, jaxpr: Any, args: Sequence[Node], scope: Scope | None) -> list[Node]:
    """The nodes of a closed jaxpr's results."""
    inner = jaxpr.jaxpr
    nodes = dict(zip(inner.invars, args, strict=True))

    def read(atom: Any) -> Node:
        number = hasattr(atom, "val")
        return graph.constant(atom.val, atom.aval.dtype.kind) if number else nodes[atom]

    for var, value in zip(inner.constvars, jaxpr.consts, strict=True):
        nodes[var] = graph.constant(value, kind_of(var.aval.dtype, graph))

    for eqn in inner.eqns:
        operands = [read(a) for a in eqn.invars]
        nodes |= zip(eqn.outvars, translated(graph, eqn, operands, scope), strict=True)
    return [read(a) for a in inner.outvars]


def translated(graph: Graph, eqn: Any, args: list[Node], scope: Scope | None) -> list[Node]:
    """The nodes of one equation's results."""
    name, params = eqn.primitive.name, eqn.params
    if name in SAME:
        return args
    if name in CALLS:
        return inlined(graph, params.get("jaxpr") or params["call_jaxpr"], args, scope)
    if name == "scan":
        return looped(graph, eqn, args, scope)
    chosen = name == "select_n" and (len(args) > 3 or args[0].kind != "b")
    if len(eqn.outvars) != 1 or chosen:
        raise Untranslatable(f"the operation {name} with {len(args)} operands")
    kind = kind_of(eqn.outvars[0].aval.dtype, graph)
    if name == "convert_element_type":
        return args if args[0].kind == kind else [graph.node("convert", args, kind)]
    return [graph.node(name, args, kind, params.get("y"))]


def looped(graph: Graph, eqn: Any, args: list[Node], outer: Scope | None) -> list[Node]:
    """The results of a `fori_loop` of known length, which JAX traces as a scan."""
    params, n = eqn.params, len(eqn.outvars)
    if any(atom.aval.ndim for atom in (*eqn.invars, *eqn.outvars)):
        raise Untranslatable("a scan over arrays")
    if not 0 < params["length"] < 2**31:
        raise Untranslatable(f"a loop of {params['length']} turns")
    consts, inits = args[:-n], args[-n:]
    assumed: list[bool] | None = None
    found = [init.uniform for init in inits]
    while found != assumed:  # what is assumed of the carry has to hold after a turn as well
        assumed, loop = found, Loop(outer, length=params["length"], inits=inits)
        loop.phis = [
            graph.place("phi", init.kind, i, uniform=same, scope=loop, of=loop)
            for i, (init, same) in enumerate(zip(inits, assumed, strict=True))
        ]
        loop.outs = inlined(graph, params["jaxpr"], [*consts, *loop.phis], loop)
        found = [u and out.uniform for u, out in zip(assumed, loop.outs, strict=True)]
    return [
        graph.place("result", phi.kind, i, uniform=phi.uniform, scope=outer, of=loop)
        for i, phi in enumerate(loop.phis)
    ]


def kind_of(dtype: np.dtype, graph: Graph) -> str:
    """f, i or b. All have the width of the numbers: whole ones are counts of less than 2^31."""
    if dtype not in (graph.dtype, np.int32, np.int64, np.bool_):
        raise Untranslatable(f"{dtype} among {graph.dtype}")
    return str(dtype.kind)
