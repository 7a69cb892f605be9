"""How a wrong sweep file is told what it should be: TOML's errors, pydantic's, and names."""

import json
import re
from typing import Any

from sweeps.spec.types import Record, Sample, Spacing, Span, Sweep, Time, suggest


def syntax(message: str, text: str) -> str:
    """A TOML error with the line it is about."""
    at = re.search(r"at line (\d+)", message)
    lines = text.strip().splitlines() or [""]
    line = text.splitlines()[int(at[1]) - 1].strip() if at else lines[-1]
    if message.startswith("Cannot overwrite"):
        message = message.replace("Cannot overwrite a value", "a key is given twice")
    return f"not valid TOML: {message}" + (f": {line[:80]}" if line else "")


_WANTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text in quotes",
    "list_type": "a list",
    "dict_type": "a table",
    "tuple_type": "a pair [a, b]",
    "model_type": "a table",
    "finite_number": "a finite number",
    "missing": "given",
    "too_short": "not empty",
    "string_pattern_mismatch": "letters, digits, '.', '_' and '-', at most 100",
}


def explain(error: Any) -> str:
    """One pydantic error as: key, what would be right, what it is."""
    kind, context = error["type"], error.get("ctx", {})
    path = [str(part) for part in error["loc"] if part not in ("list", "table", "text")]
    key = ".".join(path) or "the file"
    if kind == "extra_forbidden":
        known = _known_keys(path[:-1])
        return f"unknown key `{key}`{suggest(path[-1], known) or one_of(known)}"
    wanted = _WANTED.get(kind)
    if kind == "list_type" and path[0] == "axes":
        wanted = "a list of numbers or a range such as { log = [1, 100], n = 16 }"
    if "error" in context:
        wanted = str(context["error"])
    elif kind in ("too_short", "too_long") and context.get("actual_length"):
        least = context.get("min_length", context.get("max_length"))
        wanted = f"{'at least' if kind == 'too_short' else 'at most'} {least} values long"
    elif kind == "string_too_long":
        wanted = f"at most {context['max_length']:,} letters long"
    elif wanted is None:
        wanted = re.sub(r"^Input should be ", "", error["msg"])
    if kind == "missing":
        return f"`{key}` must be given, but is missing."
    return f"`{key}` must be {wanted}, but is {beginning(error['input'])}."


def beginning(value: Any) -> str:
    """A wrong value as the file has it, cut where it is long."""
    try:
        return json.dumps(value, default=str)[:60]
    except (ValueError, RecursionError):  # Python prints no number of thousands of digits
        return "too long to be shown"


def one_of(known: list[str]) -> str:
    """What could have been meant, where nothing is close."""
    return "; known are " + ", ".join(known)


def _known_keys(path: list[str]) -> list[str]:
    models: dict[str, type[Record]] = {"": Sweep, "time": Time, "sample": Sample}
    if path and path[0] == "axes":
        return list(Spacing.model_fields)
    if path[:2] == ["sample", "ranges"]:
        return list(Span.model_fields)
    return list(models.get(".".join(path), Sweep).model_fields)
