"""`--set KEY=VALUE` applied to the plain record of a sweep file."""

import tomllib
from typing import Any

from fic_jax import CHOICES, QUANTITIES
from sweeps.spec.types import SweepError, Time, shown, suggest
from sweeps.spec.wording import one_of

PLAIN = ("name", "description", "metrics", "error_estimate")  # keys outside any table


def override(raw: dict[str, Any], text: str) -> None:
    """Apply `--set KEY=VALUE`: a number becomes a constant, a list or a range an axis.

    KEY is a field of Params, a choice of the model or any other key of the file by its own name;
    VALUE is TOML, and a bare word is a text. A field leaves the place it had.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise SweepError(f"--set {shown(text)}: must be KEY=VALUE, as in --set K0=10")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):
        parsed = value.strip()
    sections = dict.fromkeys(Time.model_fields, "time") | dict.fromkeys(CHOICES, "model")
    sections |= dict.fromkeys(("n", "method", "seed"), "sample")
    if key in QUANTITIES:
        _move(raw, key, parsed)
    elif key in sections:
        _put(raw, sections[key], key, parsed)
    elif key in PLAIN:
        raw[key] = parsed
    else:
        known = [*QUANTITIES, *sections, *PLAIN]
        hint = suggest(key, known) or one_of(known)
        raise SweepError(f"--set {shown(text)}: unknown key `{shown(key)}`{hint}")


def _move(raw: dict[str, Any], name: str, value: Any) -> None:
    section = "axes" if isinstance(value, list | dict) else "constants"
    sample = raw.get("sample")
    ranges = sample.get("ranges") if isinstance(sample, dict) else None
    for place in (raw.get("constants"), raw.get("cases"), ranges, raw.get("axes")):
        # an axis that stays one keeps its position
        if isinstance(place, dict) and not (section == "axes" and place is raw.get("axes")):
            place.pop(name, None)
    _put(raw, section, name, value)


def _put(raw: dict[str, Any], section: str, name: str, value: Any) -> None:
    table = raw.setdefault(section, {})
    if isinstance(table, dict):  # what is no table is told by the validation that follows
        table[name] = value
