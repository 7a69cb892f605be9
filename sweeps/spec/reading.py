"""From the text of a sweep file, or the record in a store, to a checked Sweep."""

import re
import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sweeps.spec import rules
from sweeps.spec.mistakes import SweepError, explain, explain_toml, printable
from sweeps.spec.overrides import override
from sweeps.spec.rules import Wrong
from sweeps.spec.types import Sweep

MAX_FILE = 1_000_000  # bytes: the TOML reader takes 4 s for a list that long
MAX_PARTS = 20  # of a dotted key: the reader takes time with their square; a sweep has four
MAX_KEYS = 1_000  # of a file: each wrong one costs a line and a search for a similar name
FOREIGN = {  # first bytes -> what such a file is
    b"\x89HDF": "a NetCDF or HDF5 file",
    b"CDF": "a NetCDF file",
    b"PK": "a zip archive",
    b"\xff\xfe": "a text in UTF-16",
    b"\xfe\xff": "a text in UTF-16",
    b"": "no text",
}
MAX_MISTAKES = 20  # lines of a SweepError; a last line counts the rest


def load(path: Path, overrides: tuple[str, ...] = ()) -> Sweep:
    """Read and check a sweep file. Raises SweepError, with a line for each mistake."""
    return parse(read_text(path), str(path), overrides)


def read_text(path: Path) -> str:
    """The text of a sweep file. Raises SweepError."""
    try:
        with path.open("rb") as file:  # a device has no end: read no more than may be used
            content = file.read(MAX_FILE + 1)
        if len(content) > MAX_FILE:
            raise SweepError(f"{path}: must be at most {MAX_FILE:,} bytes long, but is longer.")
        return content.decode("utf-8-sig")  # some editors write a byte order mark
    except UnicodeDecodeError:
        kind = next((kind for first, kind in FOREIGN.items() if content.startswith(first)))
        wanted = f"is {kind}; a sweep file is TOML, a text in UTF-8"
        raise SweepError(f"{printable(str(path))}: {wanted}") from None
    except IsADirectoryError:
        raise SweepError(f"{printable(str(path))}: is a folder, no sweep file") from None
    except FileNotFoundError:
        raise SweepError(f"{printable(str(path))}: there is no such file") from None
    except (OSError, ValueError) as error:
        raise SweepError(
            f"{printable(str(path))}: can't be read: {printable(str(error))}"
        ) from None


def parse(text: str, source: str, overrides: tuple[str, ...] = ()) -> Sweep:
    """Check the text of a sweep file. Raises SweepError; each line begins with `source`."""
    if len(text) > MAX_FILE:
        raise SweepError(f"{source}: must be at most {MAX_FILE:,} letters long, but is longer.")
    if _LONG_KEY.search(text):
        raise SweepError(f"{source}: a key must have at most {MAX_PARTS} parts, but one has more.")
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SweepError(f"{source}: {printable(explain_toml(str(error), text))}") from None
    except RecursionError:
        raise SweepError(f"{source}: not valid TOML: nested too deeply") from None
    except ValueError:  # Python converts at most 4300 digits
        raise SweepError(f"{source}: not valid TOML: a number of thousands of digits") from None
    wrong = []
    for assignment in overrides:
        try:
            override(raw, assignment)
        except SweepError as error:
            wrong.append(str(error))
    if wrong:
        raise SweepError("\n".join(wrong))
    return validate(raw, f"{source} with --set" if overrides else source)


def validate(raw: dict[str, Any], source: str) -> Sweep:
    """Check a plain record. Raises SweepError; each line begins with `source`."""
    if _more_keys_than(raw, MAX_KEYS):
        raise SweepError(f"{source}: must have at most {MAX_KEYS:,} keys, but has more.")
    sweep, lines, wrong = _without_wrong_entries(raw)
    if sweep:
        lines += rules.unknown_names(sweep)
        lines += rules.reduction(sweep, wrong)
        lines += rules.refinement(sweep, wrong)
        known = rules.known_names(sweep)
        lines += rules.placement(known)
        lines += [] if wrong.any("time") else rules.time_grid(known)
        lines += rules.fields_out_of_bounds(known)
        if not lines:  # otherwise these could follow from another mistake
            lines += [*rules.nothing_swept(sweep), *rules.pairs_out_of_bounds(sweep)]
    if lines or not sweep:
        raise _mistakes(source, lines)
    return sweep


def _without_wrong_entries(raw: dict[str, Any]) -> tuple[Sweep | None, list[str], Wrong]:
    """The record as a Sweep without its wrong entries, a line for each of these, and their names.

    None instead of the Sweep if what is left is none.
    """
    try:
        return Sweep.model_validate(raw), [], Wrong()
    except ValidationError as errors:
        wrong = errors.errors()
    rest = deepcopy(raw)
    for error in wrong:
        _remove(rest, [str(part) for part in error["loc"]])
    try:
        sweep = Sweep.model_validate({"name": "unnamed"} | rest)
    except ValidationError:
        sweep = None
    lines = [explain(error) for error in wrong]
    # a key that is missing because it is misspelt is one mistake
    misspelt = [line.rpartition("; did you mean ")[2] for line in lines]
    kept = [
        line
        for error, line in zip(wrong, lines, strict=True)
        if not (error["type"] == "missing" and f"`{error['loc'][-1]}`?" in misspelt)
    ]
    places = frozenset(".".join(str(part) for part in error["loc"][:2]) for error in wrong)
    return sweep, list(dict.fromkeys(kept)), Wrong(places)


def _remove(record: dict[str, Any], place: list[str]) -> None:
    """Remove the entry at a place of a record, and what can't be checked without it."""
    table = record.get(place[0])
    if place[0] == "sample" or len(place) < 2 or not isinstance(table, dict):
        record.pop(place[0], None)
        return
    inner = table.get(place[1])
    if place[0] in ("reduce", "refine") and len(place) > 2 and isinstance(inner, dict):
        inner.pop(place[2], None)
    else:
        table.pop(place[1], None)
    name = ".".join(place[:2])
    if name in _NEUTRAL:
        table[place[1]] = _NEUTRAL[name]
    if place[0] == "time":  # a period is compared with dt
        for other in ("constants", "axes", "cases"):
            if isinstance(record.get(other), dict):
                record[other].pop("period", None)


# What stands for a wrong entry that a table needs, so that its other entries are checked.
_NEUTRAL: dict[str, Any] = {"reduce.over": [""], "refine.levels": 1, "refine.classes": []}


def _mistakes(source: str, lines: list[str]) -> SweepError:
    """All mistakes as one error of at most MAX_MISTAKES + 1 lines."""
    first = [printable(line) for line in lines[:MAX_MISTAKES]]
    if len(lines) > MAX_MISTAKES:
        first.append(f"and {len(lines) - MAX_MISTAKES:,} more mistakes")
    return SweepError("\n".join(f"{source}: {line}" for line in first))


_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"(?:^|[\[{{,])[ \t]*+(?:{_PART}[ \t]*+\.[ \t]*+){{{MAX_PARTS}}}", re.MULTILINE
)


def _more_keys_than(raw: Any, most: int) -> bool:
    """Whether a record has more than `most` keys in all its tables, those in lists included."""
    todo, n = [raw], 0
    while todo and n <= most:
        value = todo.pop()
        if isinstance(value, dict):
            n += len(value)
            todo.extend(value.values())
        elif isinstance(value, list):
            todo.extend(one for one in value if isinstance(one, dict | list))
    return n > most
