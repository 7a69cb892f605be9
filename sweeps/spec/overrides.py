"""`--set KEY=VALUE`: a change of a sweep file's plain record before it is checked."""

import tomllib
from typing import Any

from fic_jax import CHOICES, QUANTITIES
from sweeps.spec.mistakes import SweepError, hint, printable
from sweeps.spec.types import Time

# keys outside any table
TOP_LEVEL = ("name", "description", "metrics", "error_estimate", "precision")


def override(raw: dict[str, Any], text: str) -> None:
    """Apply `--set KEY=VALUE` to `raw`.

    KEY is a field of Params, a choice of Model or another key of the file, without its table.
    VALUE is TOML; a bare word is a text. A field of Params becomes a constant if VALUE is a number
    and an axis if it is a list or a range; any former value of the field is removed.

    Raises SweepError if `text` is no KEY=VALUE or KEY is unknown.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise SweepError(f"--set {printable(text)}: must be KEY=VALUE, as in --set K0=10")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):
        parsed = value.strip()
    tables = dict.fromkeys(Time.model_fields, "time") | dict.fromkeys(CHOICES, "model")
    tables |= dict.fromkeys(("n", "method", "seed"), "sample")
    if key in QUANTITIES:
        _move(raw, key, parsed)
    elif key in tables:
        _put(raw, tables[key], key, parsed)
    elif key in TOP_LEVEL:
        raw[key] = parsed
    else:
        advice = hint(key, [*QUANTITIES, *tables, *TOP_LEVEL])
        raise SweepError(f"--set {printable(text)}: unknown key `{printable(key)}`{advice}")


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
