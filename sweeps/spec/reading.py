"""From the text of a sweep file to a checked Sweep, or to a clear line for each thing wrong."""

import re
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sweeps.spec import rules
from sweeps.spec.overrides import override
from sweeps.spec.types import Sweep, SweepError, shown
from sweeps.spec.wording import explain, syntax

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
        raise SweepError(f"{source}: {shown(syntax(str(error), text))}") from None
    except RecursionError:
        raise SweepError(f"{source}: not valid TOML: nested too deeply") from None
    except ValueError:  # Python reads 4300 digits
        raise SweepError(f"{source}: not valid TOML: a number of thousands of digits") from None
    for assignment in overrides:
        override(raw, assignment)
    return validate(raw, source)


def validate(raw: dict[str, Any], source: str) -> Sweep:
    """Turn a plain record into a Sweep, or raise SweepError."""
    if _more_keys_than(raw, MAX_KEYS):
        raise SweepError(f"{source}: must have at most {MAX_KEYS:,} keys, but has more.")
    try:
        sweep = Sweep.model_validate(raw)
    except ValidationError as errors:
        raise _refusal(source, [explain(error) for error in errors.errors()]) from None
    # in stages: what is wrong with a name says nothing more about its values
    for stage in (rules.unknown_names, rules.placement, rules.time_grid, rules.out_of_bounds):
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
