"""`--set KEY=VALUE`: a change of a sweep file's plain record before it is checked."""

import re
import tomllib
from collections.abc import Iterable
from typing import Any

from fic_jax import CHOICES, QUANTITIES
from sweeps.spec.mistakes import SweepError, hint, printable
from sweeps.spec.types import Reduction, Refinement, Time

# keys outside any table
TOP_LEVEL = ("name", "description", "metrics", "error_estimate", "precision")


def refuse_repeated(texts: Iterable[str]) -> None:
    """Raise SweepError if two of `--set KEY=VALUE` have the same KEY."""
    seen: set[str] = set()
    for text in texts:
        key = text.partition("=")[0].strip()
        if key in seen:
            raise SweepError(f"--set {printable(text)}: `{printable(key)}` must be set once")
        seen.add(key)


def override(raw: dict[str, Any], text: str) -> None:
    """Apply `--set KEY=VALUE` to `raw`.

    KEY is a field of Params, a choice of Model or another key of the file, without its table.
    VALUE is TOML, or a number as Python writes it; words need no quotes. A field of Params becomes
    a constant if VALUE is a number and an axis if it is a list or a range; any former value of the
    field is removed.

    Raises SweepError if `text` is no KEY=VALUE or KEY is unknown.
    """
    key, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not key:
        raise SweepError(f"--set {printable(text)}: must be KEY=VALUE, as in --set K0=10")
    parsed = _value(value)
    tables = dict.fromkeys(Time.model_fields, "time") | dict.fromkeys(CHOICES, "model")
    tables |= dict.fromkeys(("n", "method", "seed"), "sample")
    tables |= dict.fromkeys(Reduction.model_fields, "reduce")
    tables |= dict.fromkeys(Refinement.model_fields, "refine")
    if key in QUANTITIES:
        if isinstance(parsed, str):
            raise SweepError(f"--set {printable(text)}: {_syntax(key, value)}")
        _move(raw, key, parsed)
    elif key in tables:
        _put(raw, tables[key], key, parsed)
    elif key in TOP_LEVEL:
        raw[key] = parsed
    else:
        advice = hint(key.rpartition(".")[2], [*QUANTITIES, *tables, *TOP_LEVEL])
        raise SweepError(f"--set {printable(text)}: unknown key `{printable(key)}`{advice}")


def _value(text: str) -> Any:
    """A value in TOML, or with numbers as Python writes them, or a list of words, or a text."""
    python = _BARE_POINT.sub(lambda m: f"{m[1] or 0}.{m[2] or 0}", text)
    words = _WORD.sub(r"'\g<0>'", text) if _LIST_OF_WORDS.fullmatch(text) else text
    for form in (text, python, words):
        try:
            return tomllib.loads(f"value = {form}")["value"]
        except (ValueError, RecursionError):
            pass
    return text


LONGEST_NUMBER = 24  # characters of a float64 in decimals
_WORD = re.compile(r"\w+")
_LIST_OF_WORDS = re.compile(r"\[\s*[a-z]\w*(?:\s*,\s*[a-z]\w*)*\s*\]")
# the numbers 1. and .5
_BARE_POINT = re.compile(r"(?<![\w.])(?:(\d+)\.(?![\d.])|\.(\d+))")


def _syntax(key: str, value: str) -> str:
    """How a field is given a number, a list or a range; with the two numbers that `value` has."""
    numbers = re.findall(r"\d+(?:\.\d+)?(?:[eE][+-]?\d+)?|(?<!\.)\.\d+", value)
    short = len(numbers) == 2 and max(map(len, numbers)) <= LONGEST_NUMBER
    ends = f"[{', '.join(numbers)}]" if short else "[1, 100]"
    forms = [f"--set '{key}={form}'" for form in (ends, f"{{ lin = {ends}, n = 16 }}")]
    return (
        f"`{key}` must be a number, a list or a range (lin or log), as in {forms[0]} or {forms[1]}"
    )


def _move(raw: dict[str, Any], name: str, value: Any) -> None:
    """Put a field into the table that its new value belongs to, out of any other table."""
    table = "axes" if isinstance(value, list | dict) else "constants"
    sample = raw.get("sample")
    ranges = sample.get("ranges") if isinstance(sample, dict) else None
    for place in (raw.get("constants"), raw.get("cases"), ranges, raw.get("axes")):
        # an axis that stays an axis keeps its position among the axes
        if isinstance(place, dict) and not (table == "axes" and place is raw.get("axes")):
            place.pop(name, None)
    _put(raw, table, name, value)


def _put(raw: dict[str, Any], table: str, name: str, value: Any) -> None:
    entries = raw.setdefault(table, {})
    if isinstance(entries, dict):  # otherwise the check of the record refuses it
        entries[name] = value
