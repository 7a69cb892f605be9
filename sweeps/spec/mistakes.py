"""A wrong request, as text: one line that names file, key, value and what would be right."""

import json
import re
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from fic_jax import CHOICES, QUANTITIES, inputs
from fic_jax.params import meaning
from sweeps.spec.types import (
    RandomDesign,
    Range,
    Record,
    Reduction,
    Refinement,
    SpacedRange,
    Sweep,
    Time,
)

OTHER_WORDS = {  # key -> what it is called elsewhere; the words of its meaning are known besides
    "period": ("rate", "frequency", "hz", "sampling", "sample_time", "ts"),
    "I": ("mass", "m", "j"),
    "Denv": ("b", "d", "viscosity"),
    "gap": ("wall", "distance", "clearance", "x_env", "xenv"),
    "Td": ("fd", "force", "reference", "setpoint"),
    "Fmax": ("tmax", "limit"),
    "dt": ("step", "timestep", "time_step", "step_size", "h"),
    "t_end": ("duration", "time", "tmax", "tend", "t"),
    "precision": ("bits", "dtype", "float"),
}
MAX_QUOTED = 300  # characters of foreign text in a message


class SweepError(Exception):
    """The request is wrong; the text has one line for each mistake."""


def printable(text: str) -> str:
    """Foreign text as part of one line: cut, and its control characters escaped."""
    cut = text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}..."
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in cut)


def hint(word: str, known: Iterable[str]) -> str:
    """'; did you mean `x`?' if `word` resembles or describes known words, else all known words."""
    meanings = {name: meaning(QUANTITIES.get(name, {})) for name in known}
    return inputs.hint(word, meanings, OTHER_WORDS)


def command(*words: object) -> str:
    """A command of ours between backticks, quoted: pasted into a shell, it works."""
    texts = [f"./{w}" if isinstance(w, Path) and str(w)[0] == "-" else str(w) for w in words]
    return f"`{shlex.join(['fic-sweep', *texts])}`"


def explain_toml(message: str, text: str) -> str:
    """An error of the TOML reader, with the line that has it."""
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
    "too_short": "not empty",
    "string_pattern_mismatch": "letters, digits, '.', '_' and '-', at most 100",
}


def misplaced(path: Sequence[str]) -> str | None:
    """What to say of a key that exists, but in another table; None of any other key."""
    table, name = path[:2] if len(path) > 1 else ("", path[0])
    home = _HOMES.get(name)
    if not home or table in (*home, "sample.ranges") or (not table and name in _TABLES):
        return None
    places = " or ".join(f"in [{place}]" if place else "at the top" for place in home)
    before = ", before any [table]" if home == ("",) else ""
    return f"`{'.'.join(filter(None, (table, name)))}` must stand {places}{before}."


_TABLES = ("time", "model", "constants", "axes", "cases", "sample", "reduce", "refine")
_HOMES: dict[str, tuple[str, ...]] = {
    **{name: ("",) for name in Sweep.model_fields if name not in _TABLES},
    **dict.fromkeys(RandomDesign.model_fields, ("sample",)),
    **dict.fromkeys(Reduction.model_fields, ("reduce",)),
    **{k: ("refine",) for k in Refinement.model_fields if k not in _TABLES},
    **dict.fromkeys(Time.model_fields, ("time",)),
    **dict.fromkeys(CHOICES, ("model",)),
    **dict.fromkeys(QUANTITIES, ("constants", "axes", "cases")),
}


def explain(error: Any) -> str:
    """One error of pydantic: the key, what would be right, the value."""
    kind, context = error["type"], error.get("ctx", {})
    path = [str(part) for part in error["loc"] if part not in ("list", "table", "text")]
    key = ".".join(path) or "the file"
    if path and (line := misplaced(path)):
        return line
    if error["loc"] and isinstance(error["loc"][-1], int):  # a person counts from 1
        where = f"value {error['loc'][-1] + 1} of `{'.'.join(path[:-1])}`"
    else:
        where = f"`{key}`"
    if kind == "missing":
        return f"`{key}` must be given, but is missing."
    if kind == "extra_forbidden":
        return f"unknown key `{key}`{hint(path[-1], _known_keys(path[:-1]))}"
    wanted = _WANTED.get(kind)
    if kind == "list_type" and path[0] == "axes":
        wanted = "a list of numbers or a range such as { log = [1, 100], n = 16 }"
    if "error" in context:
        wanted = str(context["error"])
    elif kind in ("too_short", "too_long") and context.get("actual_length"):
        limit = context.get("min_length", context.get("max_length"))
        wanted = f"{'at least' if kind == 'too_short' else 'at most'} {limit} values long"
    elif kind == "string_too_long":
        wanted = f"at most {context['max_length']:,} letters long"
    elif wanted is None:
        wanted = re.sub(r"^Input should be ", "", error["msg"])
    return f"{where} must be {wanted}, but is {excerpt(error['input'])}."


def excerpt(value: Any) -> str:
    """The first 60 characters of a wrong value, written as in the file."""
    try:
        return json.dumps(value, default=str)[:60]
    except (ValueError, RecursionError):  # Python prints no number of thousands of digits
        return "too long to be shown"


def _known_keys(path: list[str]) -> list[str]:
    records: dict[str, type[Record]] = {"": Sweep, "time": Time, "sample": RandomDesign}
    records |= {"reduce": Reduction, "refine": Refinement}
    if path and path[0] == "axes":
        return list(SpacedRange.model_fields)
    if path[:2] == ["sample", "ranges"]:
        return list(Range.model_fields)
    return list(records.get(".".join(path), Sweep).model_fields)
