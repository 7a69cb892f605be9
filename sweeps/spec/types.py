"""The records of a sweep file: a Sweep and its tables."""

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

MAX_AXIS = 10_000_000  # values of one axis: memory holds them all, but never the grid
MAX_PERIODS = 1_000_000  # values of a `period` axis: each is compared with dt
MAX_CASES = 10_000  # rows of [cases]: a person writes them
MAX_CELLS = 10**12  # scenarios of a sweep: each float32 variable then takes 4 TB
MAX_NAMES = 100  # metrics or choices in a list: fic_jax has fewer
MAX_STEPS = 100_000_000  # plant steps: the engine counts them in int32
# Fields that share a check with another field: xb > x0, K0 x0 > Fmax, the stiffest scenario.
COUPLED = ("K0", "Fmax", "x0", "xb", "S", "I", "Kenv", "Denv")
STORED = tuple(name for name in METRICS if name != "finite")  # the store has `status` instead

Number = Annotated[float, Strict(), AllowInfNan(False)]
Count = Annotated[int, Strict(), Field(ge=2, le=MAX_AXIS)]
Method = Literal["sobol", "lhs", "random"]


class Record(BaseModel):
    """Base of the tables of a sweep file: frozen, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Range(Record):
    """All values between two ends: `{ log = [a, b] }` or `{ lin = [a, b] }`."""

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
        """Values at fractions 0..1 of the range, on its scale; 0 and 1 give the exact ends."""
        a, b = self.ends
        if self.lin:
            inside = a + (b - a) * fraction
        else:
            inside = np.exp(np.log(a) + (np.log(b) - np.log(a)) * fraction)
        return np.where(fraction == 0.0, a, np.where(fraction == 1.0, b, inside))


class SpacedRange(Range):
    """`n` values evenly spaced over a range, both ends included."""

    n: Count

    def values(self, part: slice = slice(None)) -> np.ndarray:
        """The values at the indices `part`; a value does not depend on `part`."""
        start, stop, _ = part.indices(self.n)
        return self.at(np.arange(start, stop) / (self.n - 1))

    @property
    def outermost(self) -> np.ndarray:
        """Both ends and the values around zero: if any value breaks a bound, one of these does."""
        a, b = self.ends
        around_zero = np.zeros(0)
        if a * b < 0:
            zero = int(a / (a - b) * (self.n - 1))
            around_zero = self.values(slice(max(zero - 1, 0), zero + 3))
        return np.concatenate([[a], around_zero, [b]])

    @property
    def distinct(self) -> bool:
        """Whether neighbouring values differ by more than their rounding."""
        a, b = np.log(self.ends) if self.log else np.array(self.ends)
        size = max(abs(a), abs(b)) + (1 if self.log else 0)
        return bool(abs(b - a) / (self.n - 1) > 4 * np.finfo(float).eps * size)


# fail_fast: a list of a million wrong values gives one mistake, not a million.
Values = Annotated[list[Number], Field(fail_fast=True, min_length=1, max_length=MAX_AXIS)]
Column = Annotated[list[Number], Field(fail_fast=True, min_length=1, max_length=MAX_CASES)]
Names = Annotated[list[str], Field(fail_fast=True, min_length=1, max_length=MAX_NAMES)]
# The tag chooses one alternative, so that pydantic explains a wrong value once, not twice.
Axis = Annotated[
    Annotated[Values, Tag("list")] | Annotated[SpacedRange, Tag("table")],
    Discriminator(lambda given: "table" if isinstance(given, dict | SpacedRange) else "list"),
]
Choice = Annotated[
    Annotated[str, Tag("text")] | Annotated[Names, Tag("list")],
    Discriminator(lambda given: "list" if isinstance(given, list) else "text"),
]


class Time(Record):
    """Table `[time]`: the time grid that all scenarios of a sweep share."""

    dt: Annotated[Number, Field(gt=0)] = 0.01  # s, plant step
    t_end: Annotated[Number, Field(gt=0)] = 10.0  # s


class RandomDesign(Record):
    """Table `[sample]`: `n` scenarios drawn at random from ranges, instead of axes."""

    n: Annotated[int, Strict(), Field(ge=1, le=2**32)]  # length of a 32-bit Sobol sequence
    method: Method = "sobol"
    seed: Annotated[int, Strict(), Field(ge=0, lt=2**63)] = 0  # the largest TOML integer
    ranges: Annotated[dict[str, Range], Field(min_length=1)]


class Sweep(Record):
    """A sweep file. With the program and the precision it determines every number of a store."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
    description: Annotated[str, Field(max_length=10_000)] = ""
    metrics: Names = list(STORED)
    error_estimate: Annotated[bool, Strict()] = False  # also store the error of each metric
    precision: Literal[32, 64] | None = None  # bits of a number; None: as the run says, or 32
    time: Time = Time()
    model: dict[str, Choice] = {}
    constants: dict[str, Number] = {}
    axes: dict[str, Axis] = {}
    cases: dict[str, Column] = {}
    sample: RandomDesign | None = None

    @property
    def n_steps(self) -> int:
        return round(self.time.t_end / self.time.dt)

    @property
    def bits(self) -> int:
        """Precision of a run that names no other."""
        return self.precision or 32

    @property
    def dims(self) -> dict[str, int]:
        """Name and length of each dimension, in order: model lists, axes, `case`, `scenario`."""
        dims = {name: len(c) for name, c in self.model.items() if isinstance(c, list)}
        for name, axis in self.axes.items():
            dims[name] = axis.n if isinstance(axis, SpacedRange) else len(axis)
        if self.cases:
            dims["case"] = len(next(iter(self.cases.values())))
        if self.sample:
            dims["scenario"] = self.sample.n
        return dims

    def axis_values(self, name: str, part: slice = slice(None)) -> np.ndarray:
        """Values of an axis at the indices `part`."""
        axis = self.axes[name]
        return axis.values(part) if isinstance(axis, SpacedRange) else np.array(axis[part])

    def record(self) -> str:
        """The sweep as JSON. A store keeps this text and compares sweeps by it.

        Two keys are attributes of the store instead. `error_estimate` changes no metric, and the
        run may have another `precision` than the file.
        """
        return self.model_dump_json(exclude_none=True, exclude={"error_estimate", "precision"})

    def values_to_check(self) -> dict[str, dict[str, np.ndarray]]:
        """Table -> field -> values. If any value of the field breaks a bound, one of these does."""
        ranges = self.sample.ranges if self.sample else {}
        return {
            "constants": {name: np.array([value]) for name, value in self.constants.items()},
            "axes": {name: self._axis_values_to_check(name) for name in self.axes},
            "cases": {name: np.array(column) for name, column in self.cases.items()},
            "sample.ranges": {name: np.array(range_.ends) for name, range_ in ranges.items()},
        }

    def _axis_values_to_check(self, name: str) -> np.ndarray:
        axis = self.axes[name]
        if isinstance(axis, list) or (name == "period" and axis.n <= MAX_PERIODS):
            return self.axis_values(name)  # any single period may be no multiple of dt
        return axis.outermost

    def extremes(self) -> Params:
        """Params [N]: each case with each combination of the axes' smallest and largest values.

        Only COUPLED fields vary. A check of two fields that fails anywhere in the sweep fails here.
        """
        tables = self.values_to_check()
        columns: dict[str, Any] = {name: v[0] for name, v in tables["constants"].items()}
        swept = tables["axes"] | tables["sample.ranges"]
        ends = {n: np.array([v.min(), v.max()]) for n, v in swept.items() if n in COUPLED}
        cases = {name: column for name, column in tables["cases"].items() if name in COUPLED}
        n_cases = max((len(column) for column in cases.values()), default=1)
        index = np.indices((n_cases, *(2 for _ in ends))).reshape(1 + len(ends), -1)
        columns |= {name: v[i] for (name, v), i in zip(ends.items(), index[1:], strict=True)}
        columns |= {name: column[index[0]] for name, column in cases.items()}
        return Params(**columns)
