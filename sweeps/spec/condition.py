"""A condition on a scenario, as `nmse_tail < 1e-3 and contact_lost == 0`: names of metrics and
fields, numbers, inf, comparisons, arithmetic, `and`, `or`, `not` and parentheses.

Python's parser reads it. Only the nodes in `_OPERATORS` and a few others are evaluated: no call, no
attribute, no index.
"""

import ast
import operator
import re
import warnings
from collections.abc import Mapping
from functools import reduce
from typing import Any

import numpy as np

_OPERATORS: dict[type[ast.AST], Any] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: np.divide,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.And: np.logical_and,
    ast.Or: np.logical_or,
    ast.Not: np.logical_not,
}
# What other languages write -> what a condition has instead.
_FOREIGN = {
    **dict.fromkeys(("&&", "&", "AND"), "`and`"),
    **dict.fromkeys(("||", "|", "OR"), "`or`"),
    **dict.fromkeys(("!", "~", "NOT"), "`not`"),
    **dict.fromkeys(("^", "**"), "a product, as `nmse * nmse`"),
    "=": "`==`",
    "<>": "`!=`",
    "≤": "`<=`",
    "≥": "`>=`",
}
_SIGN = re.compile(r"<>|[<>=!]=|&&|\|\||\*\*|[&|~!=^≤≥]|\b(?:AND|OR|NOT)\b")
LARGEST = 1e300  # number in a condition: a longer whole one is no float
MOST_NODES = 200  # of a condition: a person writes ten


class ConditionError(Exception):
    """A text is no condition; the message says what would be right."""


def names(text: str) -> list[str]:
    """The names in a condition, each once. Raises ConditionError if it is none."""
    tree = _parsed(text)
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    words = [n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and id(n) not in called]
    found = [word for word in words if word != "inf"]
    holds(text, dict.fromkeys(found, 1.0))  # on trial
    return list(dict.fromkeys(found))


def holds(text: str, values: Mapping[str, Any]) -> np.ndarray:
    """Where a condition is true, for arrays or numbers by name. Raises ConditionError."""
    with np.errstate(all="ignore"):  # inf - inf is NaN, and no comparison with NaN is true
        result = np.asarray(_value(_parsed(text), values))
    _require(_logical(result))
    return result


def _parsed(text: str) -> ast.expr:
    for sign in _SIGN.findall(text):
        if sign in _FOREIGN:
            raise ConditionError(f"written with {_FOREIGN[sign]}, not with `{sign}`")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what Python says of a text like `1if`
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = getattr(error, "msg", None) or "it is nested too deeply"
        raise ConditionError(f'a condition, as "nmse_tail < 1e-3" ({reason})') from None
    if sum(1 for _ in ast.walk(tree)) > MOST_NODES:
        raise ConditionError(f"a condition of at most {MOST_NODES} names, numbers and operators")
    return tree


def _value(node: ast.expr, values: Mapping[str, Any]) -> Any:
    """The value of a part of a condition: true or false where it is logical, else a number."""

    def of(parts: list[ast.expr], logical: bool) -> list[Any]:
        found = [_value(part, values) for part in parts]
        _require(all(_logical(value) == logical for value in found))
        return found

    result: Any = None
    match node:
        case ast.BoolOp(op=op, values=parts):
            result = reduce(_OPERATORS[type(op)], of(parts, logical=True))
        case ast.UnaryOp(op=op, operand=part):
            logical = isinstance(op, ast.Not)
            result = _operator(op)(*of([part], logical))
        case ast.Compare(left=left, ops=ops, comparators=others):
            sides = of([left, *others], logical=False)
            pairs = zip(ops, sides, sides[1:], strict=False)
            result = reduce(np.logical_and, [np.asarray(_operator(op)(a, b)) for op, a, b in pairs])
        case ast.BinOp(left=left, op=op, right=right):
            result = _operator(op)(*of([left, right], logical=False))
        case ast.Call(func=ast.Name(id="abs"), args=[part], keywords=[]):
            result = np.abs(of([part], logical=False)[0])
        case ast.Name(id="inf"):
            result = np.inf
        case ast.Name(id=name):
            result = values[name]
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            _require(abs(value) < LARGEST)
            result = float(value)
        case _:
            _require(False)
    return result


def _operator(op: ast.AST) -> Any:
    _require(type(op) in _OPERATORS)
    return _OPERATORS[type(op)]


def _logical(value: Any) -> bool:
    return np.asarray(value).dtype == bool


def _require(allowed: bool) -> None:
    if not allowed:
        raise ConditionError(
            "a comparison of names and numbers with + - * / abs(), `and`, `or`, `not` alone"
        )
