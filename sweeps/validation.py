"""From the text of a sweep file to a checked Sweep, or to a clear line for each thing wrong."""

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from pydantic import ValidationError

from fic_jax import CHOICES, QUANTITIES, Model, ParamsError
from fic_jax.params import check, check_field, suggest
from sweeps.spec import (
    MAX_AXIS,
    MAX_STEPS,
    STORED,
    Record,
    Sample,
    Spacing,
    Span,
    Sweep,
    SweepError,
    Time,
)


def load(path: Path, overrides: tuple[str, ...] = ()) -> Sweep:
    """Read and validate a sweep file. Raises SweepError, one line for each problem."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SweepError(f"{path}: there is no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SweepError(f"{path}: can't be read: {error}") from None
    return parse(text, str(path), overrides)


def parse(text: str, source: str, overrides: tuple[str, ...] = ()) -> Sweep:
    """Validate the text of a sweep file; `source` names it in messages."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SweepError(f"{source}: {_syntax(str(error), text)}") from None
    except RecursionError:
        raise SweepError(f"{source}: not valid TOML: nested too deeply") from None
    for override in overrides:
        _override(raw, override)
    return validate(raw, source)


def validate(raw: dict[str, Any], source: str) -> Sweep:
    """Turn a plain record into a Sweep, or raise SweepError."""
    try:
        sweep = Sweep.model_validate(raw)
    except ValidationError as errors:
        lines = [f"{source}: {_explain(error)}" for error in errors.errors()]
        raise SweepError("\n".join(lines)) from None
    for problem in _problems(sweep):
        raise SweepError(f"{source}: {problem}")
    return sweep


def _syntax(message: str, text: str) -> str:
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


def _explain(error: Any) -> str:
    """One pydantic error as: key, what would be right, what it is."""
    kind, context = error["type"], error.get("ctx", {})
    path = [str(part) for part in error["loc"] if part not in ("list", "table", "text")]
    key = ".".join(path) or "the file"
    if kind == "extra_forbidden":
        known = _known_keys(path[:-1])
        return f"unknown key `{key}`{suggest(path[-1], known) or _one_of(known)}"
    wanted = _WANTED.get(kind)
    if kind == "list_type" and path[0] == "axes":
        wanted = "a list of numbers or a range such as { log = [1, 100], n = 16 }"
    if "error" in context:
        wanted = str(context["error"])
    elif kind in ("too_short", "too_long") and context.get("actual_length"):
        least = context.get("min_length", context.get("max_length"))
        wanted = f"{'at least' if kind == 'too_short' else 'at most'} {least} values long"
    elif wanted is None:
        wanted = re.sub(r"^Input should be ", "", error["msg"])
    if kind == "missing":
        return f"`{key}` must be given, but is missing."
    given = json.dumps(error["input"], default=str)
    return f"`{key}` must be {wanted}, but is {given[:60]}."


def _one_of(known: list[str]) -> str:
    return "; known are " + ", ".join(known)


def _known_keys(path: list[str]) -> list[str]:
    models: dict[str, type[Record]] = {"": Sweep, "time": Time, "sample": Sample}
    if path and path[0] == "axes":
        return list(Spacing.model_fields)
    if path[:2] == ["sample", "ranges"]:
        return list(Span.model_fields)
    return list(models.get(".".join(path), Sweep).model_fields)


def _problems(sweep: Sweep) -> Iterator[str]:
    """What the types can't say: names, places, bounds, the time grid. Yields lines."""
    yield from _unknown_names(sweep)
    yield from _placement(sweep)
    yield from _time_grid(sweep)
    for section, fields in sweep.given().items():
        for name, values in fields.items():
            try:
                check_field(name, values, sweep.time.dt)
            except ParamsError as error:
                yield f"`{section}.{name}` must be {error.wanted}, but is {error.value}."
    try:
        check(sweep.extremes(), sweep.time.dt)
    except ParamsError as error:
        given = any(error.key in fields for fields in sweep.given().values())
        default = "" if given else " (the default)"
        yield f"`{error.key}` must be {error.wanted}, but is {error.value}{default}."


def _unknown_names(sweep: Sweep) -> Iterator[str]:
    for section, fields in sweep.given().items():
        for name in fields:
            if name not in QUANTITIES:
                hint = suggest(name, list(QUANTITIES)) or _one_of(list(QUANTITIES))
                yield f"unknown key `{section}.{name}`{hint}"
    for name, chosen in sweep.model.items():
        if name not in CHOICES:
            hint = suggest(name, list(CHOICES)) or _one_of(list(CHOICES))
            yield f"unknown key `model.{name}`{hint}"
            continue
        options = chosen if isinstance(chosen, list) else [chosen]
        if len(set(options)) < len(options):
            yield f"`model.{name}` must be choices that differ, but is {options}."
        for option in options:
            try:
                Model(**cast(Any, {name: option}))
            except ParamsError as error:
                yield f"`model.{name}` must be {error.wanted}, but is {error.value}."
    for name in sweep.metrics:
        if name not in STORED:
            yield f"unknown metric `{name}`{suggest(name, STORED) or _one_of(list(STORED))}"
    if len(set(sweep.metrics)) < len(sweep.metrics):
        yield f"`metrics` must be different from each other, but is {sweep.metrics}."


def _placement(sweep: Sweep) -> Iterator[str]:
    """Each field has one place; axes and a sample exclude each other; cases are equally long."""
    if sweep.sample and sweep.axes:
        yield "`sample` must be given instead of `axes`, but both are there."
    places: dict[str, str] = {}
    for section, fields in sweep.given().items():
        for name in fields:
            if name in places:
                yield f"`{section}.{name}` must be given once, but is in `{places[name]}` too."
            places[name] = section
    lengths = {name: len(values) for name, values in sweep.cases.items()}
    if len(set(lengths.values())) > 1:
        yield f"`cases` must be columns of equal length, but are {lengths}."
    for name in sweep.axes:
        values = sweep.axis_values(name)
        if len(np.unique(values)) < len(values):
            yield f"`axes.{name}` must be values that differ, but some are given twice."
    lists = any(isinstance(chosen, list) for chosen in sweep.model.values())
    if not (sweep.axes or sweep.cases or sweep.sample or lists):
        yield "`axes` must name at least one quantity to sweep, but is empty."
    if sweep.sample and "period" in sweep.sample.ranges:
        yield "`sample.ranges.period` must be an axis or a case: it is a multiple of dt."
    if sweep.sample and sweep.sample.method == "lhs" and sweep.sample.n > MAX_AXIS:
        yield f"`sample.n` must be at most {MAX_AXIS} with lhs, but is {sweep.sample.n}."


def _time_grid(sweep: Sweep) -> Iterator[str]:
    dt, t_end = sweep.time.dt, sweep.time.t_end
    steps = t_end / dt
    if abs(steps - round(steps)) > 1e-6 * steps or round(steps) < 1:
        near = max(round(steps), 1) * dt
        wanted = f"a whole multiple of dt = {dt:g} s (nearest: {near:g})"
        yield f"`time.t_end` must be {wanted}, but is {t_end:g}."
    elif steps > MAX_STEPS:
        yield f"`time.t_end` must be at most {MAX_STEPS} steps of dt, but is {steps:.3g} steps."


def _override(raw: dict[str, Any], text: str) -> None:
    """Apply `--set KEY=VALUE`: a number becomes a constant, a list or a range an axis.

    KEY is a field of Params, a choice of the model, `dt` or `t_end`; VALUE is TOML, and a bare
    word is a text. A field leaves the place it had.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise SweepError(f"--set {text}: must be KEY=VALUE, as in --set K0=10")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    if key in ("dt", "t_end"):
        raw.setdefault("time", {})[key] = parsed
    elif key in CHOICES:
        raw.setdefault("model", {})[key] = parsed
    elif key in QUANTITIES:
        _move(raw, key, parsed)
    else:
        known = [*QUANTITIES, *CHOICES, "dt", "t_end"]
        hint = suggest(key, known) or _one_of(known)
        raise SweepError(f"--set {text}: unknown key `{key}`{hint}")


def _move(raw: dict[str, Any], name: str, value: Any) -> None:
    section = "axes" if isinstance(value, list | dict) else "constants"
    places = [raw.get("constants"), raw.get("cases"), (raw.get("sample") or {}).get("ranges")]
    for place in places:
        if isinstance(place, dict):
            place.pop(name, None)
    axes = raw.get("axes")
    if isinstance(axes, dict) and section == "constants":
        axes.pop(name, None)
    raw.setdefault(section, {})[name] = value  # an axis keeps its position
