"""From the text of a sweep file to a checked Sweep, or to a clear line for each thing wrong."""

import json
import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from pydantic import ValidationError

from fic_jax import CHOICES, QUANTITIES, Model, Params, ParamsError
from fic_jax.params import check, check_field
from sweeps.grid import dims_of
from sweeps.spec import (
    MAX_AXIS,
    MAX_CELLS,
    MAX_PERIODS,
    MAX_STEPS,
    STORED,
    Record,
    Sample,
    Spacing,
    Span,
    Sweep,
    SweepError,
    Time,
    shown,
    suggest,
)

MAX_FILE = 1_000_000  # bytes: the TOML reader takes 4 s for a list that long; a range is short
MAX_PARTS = 20  # of a dotted key: the reader's time goes with their square; a sweep has four
MAX_KEYS = 1_000  # of a file: each wrong one is a line and a search for what was meant
MAX_TOLD = 20  # mistakes


def load(path: Path, overrides: tuple[str, ...] = ()) -> Sweep:
    """Read and validate a sweep file. Raises SweepError, one line for each problem."""
    try:
        with path.open("rb") as file:  # not all of it: it could be a device without an end
            content = file.read(MAX_FILE + 1)
        if len(content) > MAX_FILE:
            raise SweepError(f"{path}: must be at most {MAX_FILE:,} bytes long, but is longer.")
        text = content.decode("utf-8-sig")  # some editors write a mark
    except FileNotFoundError:
        raise SweepError(f"{path}: there is no such file") from None
    except (OSError, ValueError) as error:
        raise SweepError(f"{shown(str(path))}: can't be read: {shown(str(error))}") from None
    return parse(text, str(path), overrides)


def parse(text: str, source: str, overrides: tuple[str, ...] = ()) -> Sweep:
    """Validate the text of a sweep file; `source` names it in messages."""
    if len(text) > MAX_FILE:
        raise SweepError(f"{source}: must be at most {MAX_FILE:,} letters long, but is longer.")
    if _LONG_KEY.search(text):
        raise SweepError(f"{source}: a key must have at most {MAX_PARTS} parts, but one has more.")
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SweepError(f"{source}: {shown(_syntax(str(error), text))}") from None
    except RecursionError:
        raise SweepError(f"{source}: not valid TOML: nested too deeply") from None
    except ValueError:  # Python reads 4300 digits
        raise SweepError(f"{source}: not valid TOML: a number of thousands of digits") from None
    for override in overrides:
        _override(raw, override)
    return validate(raw, source)


def validate(raw: dict[str, Any], source: str) -> Sweep:
    """Turn a plain record into a Sweep, or raise SweepError."""
    if _more_keys_than(raw, MAX_KEYS):
        raise SweepError(f"{source}: must have at most {MAX_KEYS:,} keys, but has more.")
    try:
        sweep = Sweep.model_validate(raw)
    except ValidationError as errors:
        raise _refusal(source, [_explain(error) for error in errors.errors()]) from None
    # in stages: what is wrong with a name says nothing more about its values
    for stage in (_unknown_names, _placement, _time_grid, out_of_bounds):
        problems = list(stage(sweep))
        if problems:
            raise _refusal(source, problems)
    return sweep


def _refusal(source: str, problems: list[str]) -> SweepError:
    """A line for each thing wrong, but not thousands."""
    told = [shown(problem) for problem in problems[:MAX_TOLD]]
    if len(problems) > MAX_TOLD:
        told.append(f"and {len(problems) - MAX_TOLD:,} more mistakes")
    return SweepError("\n".join(f"{source}: {line}" for line in told))


_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"(?:^|[\[{{,])[ \t]*+(?:{_PART}[ \t]*+\.[ \t]*+){{{MAX_PARTS}}}", re.MULTILINE
)


def _more_keys_than(raw: Any, most: int) -> bool:
    """Whether a record has too many keys in all its tables, be they nested in lists."""
    left, n = [raw], 0
    while left and n <= most:
        value = left.pop()
        if isinstance(value, dict):
            n += len(value)
            left.extend(value.values())
        elif isinstance(value, list):
            left.extend(one for one in value if isinstance(one, dict | list))
    return n > most


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
    elif kind == "string_too_long":
        wanted = f"at most {context['max_length']:,} letters long"
    elif wanted is None:
        wanted = re.sub(r"^Input should be ", "", error["msg"])
    if kind == "missing":
        return f"`{key}` must be given, but is missing."
    return f"`{key}` must be {wanted}, but is {_beginning(error['input'])}."


def _beginning(value: Any) -> str:
    """A wrong value as the file has it, cut where it is long."""
    try:
        return json.dumps(value, default=str)[:60]
    except (ValueError, RecursionError):  # Python prints no number of thousands of digits
        return "too long to be shown"


def _one_of(known: list[str]) -> str:
    return "; known are " + ", ".join(known)


def _known_keys(path: list[str]) -> list[str]:
    models: dict[str, type[Record]] = {"": Sweep, "time": Time, "sample": Sample}
    if path and path[0] == "axes":
        return list(Spacing.model_fields)
    if path[:2] == ["sample", "ranges"]:
        return list(Span.model_fields)
    return list(models.get(".".join(path), Sweep).model_fields)


def out_of_bounds(sweep: Sweep, dtype: str = "float64") -> Iterator[str]:
    """Values no scenario may have once they are `dtype`: bounds, the time grid, xb > x0."""
    good = True
    for section, fields in sweep.given().items():
        for name, values in fields.items():
            try:
                check_field(name, _cast(values, dtype), sweep.time.dt)
            except ParamsError as error:
                good = False
                yield f"`{section}.{name}` must be {error.wanted}, but is {error.value}."
    if not good:
        return
    extremes = Params(**{k: _cast(v, dtype) for k, v in vars(sweep.extremes()).items()})
    try:
        check(extremes, sweep.time.dt)
    except ParamsError as error:
        given = any(error.key in fields for fields in sweep.given().values())
        default = "" if given else " (the default)"
        yield f"`{error.key}` must be {error.wanted}, but is {error.value}{default}."


def _cast(values: Any, dtype: str) -> np.ndarray:
    with np.errstate(over="ignore", under="ignore"):  # told as inf or zero where it happens
        return np.asarray(values, dtype)


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
        axis = sweep.axes[name]
        if not (axis.distinct if isinstance(axis, Spacing) else len(set(axis)) == len(axis)):
            yield f"`axes.{name}` must be values that differ, but some are given twice."
    lists = any(isinstance(chosen, list) for chosen in sweep.model.values())
    if not (sweep.axes or sweep.cases or sweep.sample or lists):
        yield "`axes` must name at least one quantity to sweep, but is empty."
    if sweep.sample and "period" in sweep.sample.ranges:
        yield "`sample.ranges.period` must be an axis or a case: it is a multiple of dt."
    yield from _sizes(sweep)


def _sizes(sweep: Sweep) -> Iterator[str]:
    """What is too much to plan or to hold."""
    cells, sample, period = (
        math.prod(dims_of(sweep).values()),
        sweep.sample,
        sweep.axes.get("period"),
    )
    if cells > MAX_CELLS:
        yield f"the sweep must have at most {MAX_CELLS:,} scenarios, but has {_beginning(cells)}."
    if sample and sample.method == "lhs" and sample.n * len(sample.ranges) > MAX_AXIS:
        most = MAX_AXIS // len(sample.ranges)
        yield f"`sample.n` must be at most {most:,} with lhs, but is {sample.n}."
    if isinstance(period, Spacing) and period.n > MAX_PERIODS:
        yield f"`axes.period.n` must be at most {MAX_PERIODS:,}, but is {period.n}."


def _time_grid(sweep: Sweep) -> Iterator[str]:
    dt, t_end = sweep.time.dt, sweep.time.t_end
    steps = t_end / dt if dt * MAX_STEPS > t_end / 2 else np.inf  # a tiny dt would overflow
    if steps > MAX_STEPS:
        yield f"`time.t_end` must be at most {MAX_STEPS:,} steps of dt, but dt is {dt:g} s."
    elif abs(steps - round(steps)) > 1e-6 * steps or round(steps) < 1:
        near = max(round(steps), 1) * dt
        wanted = f"a whole multiple of dt = {dt:g} s (nearest: {near:g})"
        yield f"`time.t_end` must be {wanted}, but is {t_end:g}."


PLAIN = ("name", "description", "metrics", "error_estimate")  # keys outside any table


def _override(raw: dict[str, Any], text: str) -> None:
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
        hint = suggest(key, known) or _one_of(known)
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
