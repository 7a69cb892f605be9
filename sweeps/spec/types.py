"""The sweep record: the types of a sweep file and what they stand for."""

import difflib
from collections.abc import Iterable
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from pydantic import (
    AllowInfNan,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    Tag,
    model_validator,
)

from fic_jax import METRICS, Params

MAX_AXIS = 10_000_000  # values of one axis: they are held in memory, the grid is not
MAX_PERIODS = 1_000_000  # of them where each is checked against dt
MAX_CASES = 10_000  # rows of [cases]: written by hand
MAX_CELLS = 10**12  # of a sweep: 4 TB for each variable in 32 bits
MAX_CHOSEN = 100  # names in a list: there are fewer to choose from
MAX_SHOWN = 300  # letters of somebody else's text in a message
MAX_STEPS = 100_000_000  # plant steps are counted in int32
# Fields that take part in a check of more than one field (xb > x0, Fmax, the stiffest scenario).
COUPLED = ("K0", "Fmax", "x0", "xb", "S", "I", "Kenv", "Denv")
STORED = tuple(name for name in METRICS if name != "finite")  # `status` in the store tells that

Number = Annotated[float, Strict(), AllowInfNan(False)]
Count = Annotated[int, Strict(), Field(ge=2, le=MAX_AXIS)]
Method = Literal["sobol", "lhs", "random"]


class SweepError(Exception):
    """A request that can't be run; its text is one clear line for each thing wrong."""


def shown(text: str) -> str:
    """Somebody else's text as a part of one line: nothing a terminal obeys, and not all of it."""
    cut = text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in cut)


def suggest(word: str, known: Iterable[str]) -> str:
    """'; did you mean `x`?' for the nearest known word, or an empty string."""
    if len(word) > MAX_SHOWN:  # comparing takes time with the square of the length
        return ""
    lower = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.5)
    return f"; did you mean `{lower[near[0]]}`?" if near else ""


class Record(BaseModel):
    """Base of the tables of a sweep file: no unknown keys, no changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Span(Record):
    """A range of values: `{ log = [a, b] }` or `{ lin = [a, b] }`."""

    log: tuple[Number, Number] | None = None
    lin: tuple[Number, Number] | None = None

    @model_validator(mode="after")
    def _one_scale(self) -> Self:
        if (self.log is None) == (self.lin is None):
            raise ValueError("either log = [a, b] or lin = [a, b]")
        if self.log and min(self.log) <= 0:
            raise ValueError("between positive ends on a log scale")
        if len(set(self.ends)) < 2:
            raise ValueError("between two different ends")
        if not np.isfinite(self.ends[1] - self.ends[0]):
            raise ValueError("between ends whose difference is finite")
        return self

    @property
    def ends(self) -> tuple[float, float]:
        return cast(tuple[float, float], self.log or self.lin)

    def at(self, fraction: np.ndarray) -> np.ndarray:
        """Values at fractions 0..1 of the range, on its own scale; the ends come out exactly."""
        a, b = self.ends
        if self.lin:
            inside = a + (b - a) * fraction
        else:
            inside = np.exp(np.log(a) + (np.log(b) - np.log(a)) * fraction)
        return np.where(fraction == 0.0, a, np.where(fraction == 1.0, b, inside))


class Spacing(Span):
    """An axis of `n` values evenly spaced over a range, both ends included."""

    n: Count

    def values(self, part: slice = slice(None)) -> np.ndarray:
        """The values at the indices `part`, the same whatever else is asked for."""
        start, stop, _ = part.indices(self.n)
        return self.at(np.arange(start, stop) / (self.n - 1))

    @property
    def outermost(self) -> np.ndarray:
        """The ends and what is nearest to zero: a bound that holds for these holds for all."""
        a, b = self.ends
        near = np.zeros(0)
        if a * b < 0:
            zero = int(a / (a - b) * (self.n - 1))
            near = self.values(slice(max(zero - 1, 0), zero + 3))
        return np.concatenate([[a], near, [b]])

    @property
    def distinct(self) -> bool:
        """Whether all values differ by more than their rounding."""
        a, b = np.log(self.ends) if self.log else np.array(self.ends)
        size = max(abs(a), abs(b)) + (1 if self.log else 0)
        return bool(abs(b - a) / (self.n - 1) > 4 * np.finfo(float).eps * size)


# Of a list the first wrong element is told: all of them could be too many to hold.
Values = Annotated[list[Number], Field(fail_fast=True, min_length=1, max_length=MAX_AXIS)]
Column = Annotated[list[Number], Field(fail_fast=True, min_length=1, max_length=MAX_CASES)]
Names = Annotated[list[str], Field(fail_fast=True, min_length=1, max_length=MAX_CHOSEN)]
# The tag keeps a wrong value from being explained twice, once for each alternative.
Axis = Annotated[
    Annotated[Values, Tag("list")] | Annotated[Spacing, Tag("table")],
    Discriminator(lambda given: "table" if isinstance(given, dict | Spacing) else "list"),
]
Choice = Annotated[
    Annotated[str, Tag("text")] | Annotated[Names, Tag("list")],
    Discriminator(lambda given: "list" if isinstance(given, list) else "text"),
]


class Time(Record):
    """The time grid, shared by all scenarios of a sweep."""

    dt: Annotated[Number, Field(gt=0)] = 0.01  # s, plant step
    t_end: Annotated[Number, Field(gt=0)] = 10.0  # s


class Sample(Record):
    """A random design instead of axes: `n` scenarios drawn from the ranges."""

    n: Annotated[int, Strict(), Field(ge=1, le=2**32)]  # a 32-bit Sobol sequence's length
    method: Method = "sobol"
    seed: Annotated[int, Strict(), Field(ge=0, lt=2**63)] = 0  # as TOML's whole numbers
    ranges: Annotated[dict[str, Span], Field(min_length=1)]


class Sweep(Record):
    """Everything that decides a sweep's numbers, but for the program and its precision."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
    description: Annotated[str, Field(max_length=10_000)] = ""
    metrics: Names = list(STORED)
    error_estimate: Annotated[bool, Strict()] = False  # also store how wrong each metric may be
    time: Time = Time()
    model: dict[str, Choice] = {}
    constants: dict[str, Number] = {}
    axes: dict[str, Axis] = {}
    cases: dict[str, Column] = {}
    sample: Sample | None = None

    @property
    def n_steps(self) -> int:
        return round(self.time.t_end / self.time.dt)

    def axis_values(self, name: str, part: slice = slice(None)) -> np.ndarray:
        """Values of an axis at the indices `part`."""
        axis = self.axes[name]
        return axis.values(part) if isinstance(axis, Spacing) else np.array(axis[part])

    def record(self) -> str:
        """The sweep as JSON: what a store keeps, and what two sweeps are compared by.

        An attribute of the store tells of estimates: they change no number, and programs older
        than them read the record too.
        """
        return self.model_dump_json(exclude_none=True, exclude={"error_estimate"})

    def given(self) -> dict[str, dict[str, np.ndarray]]:
        """Every field the sweep sets: section -> name -> its values, of a range what bounds it."""
        ranges = self.sample.ranges if self.sample else {}
        axes = {name: self._bounding(name) for name in self.axes}
        return {
            "constants": {name: np.array([value]) for name, value in self.constants.items()},
            "axes": axes,
            "cases": {name: np.array(column) for name, column in self.cases.items()},
            "sample.ranges": {name: np.array(span.ends) for name, span in ranges.items()},
        }

    def _bounding(self, name: str) -> np.ndarray:
        """Values of an axis that break any bound of one field, if one does."""
        axis = self.axes[name]
        if isinstance(axis, list) or (name == "period" and axis.n <= MAX_PERIODS):
            return self.axis_values(name)  # a period in between may be no multiple of dt
        return axis.outermost

    def extremes(self) -> Params:
        """Params with a leaf for each case and each combination of the axes' ends.

        Only of the fields that bounds couple: any two of them meet at their worst in here.
        """
        given = self.given()
        columns: dict[str, Any] = {name: v[0] for name, v in given["constants"].items()}
        swept = given["axes"] | given["sample.ranges"]
        ends = {n: np.array([v.min(), v.max()]) for n, v in swept.items() if n in COUPLED}
        cases = {name: column for name, column in given["cases"].items() if name in COUPLED}
        n_cases = max((len(column) for column in cases.values()), default=1)
        index = np.indices((n_cases, *(2 for _ in ends))).reshape(1 + len(ends), -1)
        columns |= {name: v[i] for (name, v), i in zip(ends.items(), index[1:], strict=True)}
        columns |= {name: column[index[0]] for name, column in cases.items()}
        return Params(**columns)
