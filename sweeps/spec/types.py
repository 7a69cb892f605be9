"""The records of a sweep file: a Sweep and its tables."""

import math
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

from fic_jax import CHOICES, METRICS, QUANTITIES, Model, Params
from fic_jax.display import Displayed, Row, Table

MAX_AXIS = 10_000_000  # values of one axis: memory holds them all, but never the grid
MAX_PERIODS = 1_000_000  # values of a `period` axis: each is compared with dt
MAX_CASES = 10_000  # rows of [cases]: a person writes them
MAX_CELLS = 10**12  # scenarios of a sweep: each float32 variable then takes 4 TB
MAX_REDUCED = 1_000_000_000  # scenarios of a cell of a reduced store: hours, without a commit
MAX_VALUES = 100_000_000  # of a quantile: 0.4 to 0.8 GB
MAX_REFINED = 100_000_000  # cells of a refined grid: choosing among them takes 30 bytes for each
MAX_RUNS = 20_000_000  # scenarios of a refined sweep: their values, 50 to 100 bytes, are in memory
MAX_LEVELS = 20
MAX_CLASSES = 7  # conditions: a byte has room for all combinations, and for what diverged
MAX_NAMES = 100  # metrics or choices in a list: fic_jax has fewer
MAX_STEPS = 100_000_000  # plant steps: the engine counts them in int32
PIECE = 1_000_000  # values computed at once: extended precision takes 16 bytes for each
RANGES = 2  # version of the values of a range; raise it with a change of any bit
ROUNDING = 4 * float(np.finfo(float).eps)  # relative: values closer than this are one value
MOST_LISTED = 6  # values of a list that a summary shows
DIGITS = 12  # most digits of a decimal that a person writes
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

    def __str__(self) -> str:
        low, high = self.ends
        return f"{low:.6g} to {high:.6g}" + (", log" if self.log else "")

    @property
    def ends(self) -> tuple[float, float]:
        return cast(tuple[float, float], self.log or self.lin)

    def at(self, fraction: np.ndarray) -> np.ndarray:
        """Values at fractions 0..1 of the range, on its scale; 0 and 1 give the exact ends.

        Computed in extended precision, then rounded: numpy's float64 `exp` and `log` differ in the
        last bit between processors, and a value must not depend on the other values of its range.
        """
        a, b = np.array(self.ends, np.longdouble)
        if self.lin:
            inside = a + (b - a) * fraction
        else:
            inside = np.exp(np.log(a) + (np.log(b) - np.log(a)) * fraction)
        first, last = self.ends
        inside = inside.astype(np.float64)
        return np.where(fraction == 0.0, first, np.where(fraction == 1.0, last, inside))

    def rounding(self, values: np.ndarray) -> np.ndarray:
        """How far each value may be from the decimal that its author means: a few roundings."""
        largest = np.abs(values) if self.log else max(map(abs, self.ends))
        return np.broadcast_to(ROUNDING * largest, np.shape(values))


class SpacedRange(Range):
    """`n` values evenly spaced over a range, both ends included."""

    n: Count

    def __str__(self) -> str:
        return f"{self.n:,} values, {super().__str__()}"

    def values(self, part: slice = slice(None)) -> np.ndarray:
        """The values at the indices `part`; a value does not depend on `part`.

        A value that is a short decimal to rounding, as 0.3 on a range from 0 to 1, is that decimal.
        """
        start, stop, _ = part.indices(self.n)
        values = np.empty(max(stop - start, 0))
        for first in range(start, stop, PIECE):
            last = min(first + PIECE, stop)
            values[first - start : last - start] = self._values(first, last)
        return values

    def _values(self, start: int, stop: int) -> np.ndarray:
        values = self.at(np.arange(start, stop, dtype=np.longdouble) / (self.n - 1))
        inside = slice(max(1 - start, 0), max(self.n - 1 - start, 0))  # the ends are as given
        values[inside] = _short_decimals(values[inside], self.rounding(values[inside]))
        return values

    @property
    def outermost(self) -> np.ndarray:
        """Both ends and the values around zero: if any value breaks a bound, one of these does."""
        a, b = self.ends
        around_zero = np.zeros(0)
        if a * b < 0:
            zero = int(a / (a - b) * (self.n - 1))
            around_zero = self.values(slice(max(zero - 1, 0), zero + 3))
        return np.concatenate([[a], around_zero, [b]])

    def closest(self) -> np.ndarray:
        """The two neighbours that differ least, in relation to their size: at the larger end."""
        first_larger = abs(self.ends[0]) > abs(self.ends[1])
        return self.values(slice(0, 2) if first_larger else slice(self.n - 2, self.n))

    def halved(self, times: int) -> "SpacedRange":
        """The range with a value midway between neighbours, on its scale, then again."""
        return self.model_copy(update={"n": (self.n - 1) * 2**times + 1})

    @property
    def distinct(self) -> bool:
        """Whether neighbouring values differ by more than their rounding."""
        a, b = np.log(self.ends) if self.log else np.array(self.ends)
        size = max(abs(a), abs(b)) + (1 if self.log else 0)
        return bool(abs(b - a) / (self.n - 1) > 4 * ROUNDING * size)


def _short_decimals(values: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """The values; those within `rounding` of a number of few digits are replaced by that number."""
    with np.errstate(all="ignore"):  # the rounding of zero has no logarithm: it stays zero
        places = np.floor(np.log10(ROUNDING / rounding)).astype(int) + DIGITS
    inexact = np.abs(places) > 22  # larger powers of ten are not exact in float64
    power = 10.0 ** np.abs(np.where(inexact, 0, places))
    with np.errstate(over="ignore", invalid="ignore"):
        decimal = np.where(
            places >= 0, np.rint(values * power) / power, np.rint(values / power) * power
        )
        short = ~inexact & (np.abs(decimal - values) <= rounding)
    return np.where(short, decimal + 0.0, values)  # no negative zero


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


def _row(name: str, text: str) -> Row:
    """A field or a choice with its values."""
    about = QUANTITIES.get(name, {"unit": "1", "meaning": "choice of the model"})
    return Row(name, text, about["unit"].removesuffix("1"), about["meaning"])


def _listed(values: list[float]) -> str:
    """Some numbers; of many the first and the last."""
    texts = [f"{value:.6g}" for value in values]
    return ", ".join(texts) if len(texts) <= MOST_LISTED else f"{texts[0]}, ..., {texts[-1]}"


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


Condition = Annotated[str, Field(max_length=1_000)]
Part = Annotated[Number, Field(ge=0, le=1)]
MetricNames = Annotated[list[str], Field(fail_fast=True, max_length=MAX_NAMES)]


class Reduction(Record):
    """Table `[reduce]`: the dimensions that go, and what the store keeps of the cells along them.

    A statistic is over all combinations of the dimensions in `over`. With `best`, that dimension
    goes too: each statistic is at its value with the smallest worst case of `by`.
    """

    over: Names
    max: MetricNames = []
    min: MetricNames = []
    mean: MetricNames = []
    std: MetricNames = []
    quantiles: Annotated[
        dict[str, Annotated[list[Part], Field(min_length=1, max_length=MAX_NAMES)]],
        Field(max_length=MAX_NAMES),
    ] = {}
    share: Annotated[dict[str, Condition], Field(max_length=MAX_NAMES)] = {}
    best: str | None = None
    by: str | None = None
    # A value is refused where a larger part of its scenarios has no number that is trusted.
    untrusted: Part = 0.0

    @property
    def gone(self) -> list[str]:
        """The dimensions that the store does not have."""
        return [*self.over, *([self.best] if self.best else [])]

    @property
    def metrics(self) -> list[str]:
        """The metrics of which the store keeps a statistic, without those in conditions."""
        by = [self.by] if self.by else []
        named = (self.max, self.min, self.mean, self.std, self.quantiles, by)
        return list(dict.fromkeys(name for names in named for name in names))

    @property
    def question(self) -> str:
        """What it asks, in one line: `over Denv, Td: best sigma by nmse; max nmse`."""
        parts = [f"best {self.best} by {self.by}"] if self.best else []
        listed = {key: getattr(self, key) for key in ("max", "min", "mean", "std")}
        parts += [f"{key} {', '.join(names)}" for key, names in listed.items() if names]
        for name, numbers in self.quantiles.items():
            parts.append(f"quantiles {', '.join(f'{part:g}' for part in numbers)} of {name}")
        parts += [f"share of {text}" for text in self.share.values()]
        parts += [f"untrusted {self.untrusted:g}"] if self.untrusted else []
        return f"over {', '.join(self.over)}: {'; '.join(parts)}"


Tolerance = Annotated[Number, Field(gt=0)]


class Refinement(Record):
    """Table `[refine]`: how often the distances on the axes may be halved, and where.

    A box of the grid is halved where its cells differ: in what conditions hold, in what diverged,
    or in a metric by more than a tolerance.
    """

    axes: Names | None = None  # None: all that are ranges
    levels: Annotated[int, Strict(), Field(ge=1, le=MAX_LEVELS)]
    budget: Annotated[int, Strict(), Field(ge=1)] | None = None  # most scenarios
    classes: Annotated[list[Condition], Field(max_length=MAX_CLASSES)] = [
        "convergence_time < inf",
        "contact_lost == 0",
    ]
    absolute: Annotated[dict[str, Tolerance], Field(max_length=MAX_NAMES)] = {}
    relative: Annotated[dict[str, Tolerance], Field(max_length=MAX_NAMES)] = {}


class Sweep(Displayed, Record):
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
    reduce: Reduction | None = None
    refine: Refinement | None = None

    @property
    def n_steps(self) -> int:
        return round(self.time.t_end / self.time.dt)

    @property
    def bits(self) -> int:
        """Precision of a run that names no other."""
        return self.precision or 32

    @property
    def dims(self) -> dict[str, int]:
        """Name and length of each dimension, in order: model lists, axes, `case`, `scenario`.

        Those that a reduction takes away are among them: a `Grid` has the dimensions of the store.
        A refined axis has its finest values.
        """
        dims = {name: len(c) for name, c in self.model.items() if isinstance(c, list)}
        for name in self.axes:
            axis = self.axis(name)
            dims[name] = axis.n if isinstance(axis, SpacedRange) else len(axis)
        if self.cases:
            dims["case"] = len(next(iter(self.cases.values())))
        if self.sample:
            dims["scenario"] = self.sample.n
        return dims

    @property
    def refined(self) -> list[str]:
        """The axes that a refinement halves."""
        if not self.refine:
            return []
        ranges = [name for name, axis in self.axes.items() if isinstance(axis, SpacedRange)]
        return ranges if self.refine.axes is None else self.refine.axes

    def axis(self, name: str) -> list[float] | SpacedRange:
        """An axis as the store has it: a refined one with its finest values."""
        axis = self.axes[name]
        if self.refine and name in self.refined and isinstance(axis, SpacedRange):
            return axis.halved(self.refine.levels)
        return axis

    def held(self) -> dict[str, float | str]:
        """Fields and choices that do not vary, with their values; defaults are among them."""
        swept = {*self.axes, *self.cases, *(self.sample.ranges if self.sample else ())}
        fields = {n: v for n, v in (vars(Params()) | self.constants).items() if n not in swept}
        choices = {name: getattr(Model(), name) for name in CHOICES} | self.model
        return fields | {n: c for n, c in choices.items() if isinstance(c, str)}

    def defaults(self) -> list[str]:
        """Those of `held` that the file does not name."""
        return [name for name in self.held() if name not in {*self.constants, *self.model}]

    def _table(self) -> Table:
        begun = self.model_copy(update={"refine": None}).dims  # what a refinement begins with
        cells, n_steps = math.prod(begun.values()), f"{self.n_steps:,} steps"
        dims = " x ".join(f"{name} {n}" for name, n in begun.items())
        title = f"Sweep {self.name}: {dims} = {cells:,} scenarios of {n_steps}"
        title += ", refined" if self.refine else ""
        held, defaults = self.held(), self.defaults()
        texts = {name: ", ".join(c) for name, c in self.model.items() if isinstance(c, list)}
        texts |= {name: str(axis) for name, axis in self.axes.items() if isinstance(axis, Range)}
        texts |= {name: _listed(axis) for name, axis in self.axes.items() if isinstance(axis, list)}
        texts |= {name: f"{_listed(column)} (case)" for name, column in self.cases.items()}
        if self.sample:
            drawn = self.sample.ranges.items()
            texts |= {name: f"{range_}, {self.sample.method}" for name, range_ in drawn}
        texts |= {n: f"{v:.6g}" if n in QUANTITIES else str(v) for n, v in held.items()}
        rows = {name: _row(name, text) for name, text in texts.items()}
        time = [Row("dt", f"{self.time.dt:g}", "s"), Row("t_end", f"{self.time.t_end:g}", "s")]
        own = [row for name, row in rows.items() if name not in defaults]
        if self.error_estimate:
            own.append(Row("error_estimate", "true"))
        if self.precision:
            own.append(Row("precision", f"{self.precision}", "bit"))
        if self.metrics != list(STORED):
            own.append(Row("metrics", ", ".join(self.metrics)))
        if self.reduce:
            best = f"; best {self.reduce.best} by {self.reduce.by}" if self.reduce.best else ""
            own.append(Row("reduce", f"over {', '.join(self.reduce.over)}{best}"))
        if self.refine:
            budget = f"{self.refine.budget:,}" if self.refine.budget else "none"
            extent = f"levels {self.refine.levels}, budget {budget}"
            meaning = f"{', '.join(self.refined)} halved where cells differ"
            own.append(Row("refine", extent, meaning=meaning))
        return Table(title, own + time, "by default", [rows[name] for name in defaults])

    def axis_values(self, name: str, part: slice = slice(None)) -> np.ndarray:
        """Values of an axis at the indices `part`."""
        axis = self.axis(name)
        return axis.values(part) if isinstance(axis, SpacedRange) else np.array(axis[part])

    def field_values(self, name: str) -> np.ndarray:
        """All values of a field of Params that is not drawn; its default, if not named."""
        if name in self.axes:
            return self.axis_values(name)
        if name in self.cases:
            return np.array(self.cases[name])
        return np.array([self.constants.get(name, getattr(Params(), name))])

    def rounding(self, name: str, values: np.ndarray) -> np.ndarray:
        """How far each value of a field may be from the one that is meant."""
        axis = self.axes.get(name)
        return axis.rounding(values) if isinstance(axis, Range) else ROUNDING * np.abs(values)

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
        axis = self.axis(name)
        if isinstance(axis, list) or (name == "period" and axis.n <= MAX_PERIODS):
            return self.axis_values(name)  # any single period may be no multiple of dt
        return axis.outermost

    def outermost(self, name: str) -> np.ndarray:
        """Values of a field, the smallest and the largest among them; its default, if not named."""
        for fields in self.values_to_check().values():
            if name in fields:
                return fields[name]
        return np.array([getattr(Params(), name)])

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
