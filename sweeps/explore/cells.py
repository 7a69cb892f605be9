"""A map in memory: a metric in the cells between two axes, and why some cells have no number."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fic_jax import METRICS, QUANTITIES
from sweeps import maps
from sweeps.explore.view import Value, View
from sweeps.spec.digits import digits

# Why a cell has no number; a code is an index. A diverged scenario is a status, not a colour.
REASONS = ("", "not run", "diverged", "failed", "infinite", "not trusted", "no value")
TICKS = 6  # of an axis, at most
CATEGORIES = 12  # names of an axis, at most
Cells = NDArray[np.bool_]


@dataclass(frozen=True)
class Axis:
    """A side of a map: n values in n cells. Drawn, it has the length 1."""

    name: str
    scale: str  # "log", "linear" or "category"
    values: NDArray[Any]

    @cached_property
    def _edges(self) -> NDArray[np.float64]:
        return maps.edges_of(self.values, self.scale)

    @cached_property
    def places(self) -> NDArray[np.float64]:
        """The n + 1 edges of the cells on the drawn side, from 0 to 1."""
        edges = np.log(self._edges) if self.scale == "log" else self._edges
        return np.asarray((edges - edges[0]) / (edges[-1] - edges[0]))

    @property
    def numeric(self) -> bool:
        return self.values.dtype.kind in "iuf"

    def at(self, place: float) -> int:
        """The cell at a place between 0 and 1."""
        found = int(np.searchsorted(self.places, place, side="right")) - 1
        return min(max(found, 0), len(self.values) - 1)

    def centre(self, value: Value) -> float | None:
        """The place of a value; None outside of the axis."""
        if not self.numeric or self.scale == "category":
            same = [i for i, one in enumerate(self.values.tolist()) if one == value]
            return float(self.places[same[0] : same[0] + 2].mean()) if same else None
        if self.scale == "log" and float(value) <= 0:
            return None
        low, high = self._edges[0], self._edges[-1]
        if self.scale == "log":
            return _inside(math.log(float(value) / low) / math.log(high / low))
        return _inside((float(value) - low) / (high - low))

    def index(self, value: Value) -> int:
        """The cell whose value is nearest."""
        if not self.numeric or self.scale == "category":
            place = self.centre(value)
            return 0 if place is None else self.at(place)
        near = np.abs(self.values.astype(float) - float(value))
        if self.scale == "log" and float(value) > 0:
            near = np.abs(np.log(self.values / float(value)))
        return int(np.argmin(near))

    def value(self, index: int) -> Value:
        """The value of a cell, as Python has it."""
        value = self.values[index].item() if self.numeric else str(self.values[index])
        return value if isinstance(value, str) else float(value)

    def ticks(self) -> list[tuple[float, str]]:
        """Places of an axis and their texts."""
        if self.scale == "category":
            step = math.ceil(len(self.values) / CATEGORIES)
            shown = range(0, len(self.values), step)
            named = [self.value(i) for i in shown]
            return [
                (float(self.places[i : i + 2].mean()), text(v))
                for i, v in zip(shown, named, strict=True)
            ]
        return [
            (p, text(v))
            for v in ticks(self._edges[0], self._edges[-1], self.scale == "log")
            if (p := self.centre(v)) is not None
        ]

    def pixels(self) -> NDArray[np.intp]:
        """The cell of each pixel of an image: cells as they are, or as wide as they are drawn."""
        n = len(self.values)
        if n <= MOST_PIXELS and np.allclose(np.diff(self.places), 1 / n, rtol=1e-3):
            return np.arange(n)
        middles = (np.arange(MOST_PIXELS) + 0.5) / MOST_PIXELS
        return np.clip(np.searchsorted(self.places, middles, side="right") - 1, 0, n - 1)


MOST_PIXELS = 512  # of a side of an image; a map is drawn about that wide


def _inside(place: float) -> float | None:
    return place if -1e-9 <= place <= 1 + 1e-9 else None


def ticks(low: float, high: float, log: bool) -> list[float]:
    """Round numbers between two ends."""
    if log and high >= 10 * low:
        first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
        step = math.ceil((last - first + 1) / TICKS)
        steps: Sequence[float] = (1, 2, 5) if last - first < 2 else (1,)
        found = [float(f"{m}e{k}") for k in range(first - 1, last + 1, step) for m in steps]
    else:
        rough = (high - low) / TICKS
        unit = 10.0 ** math.floor(math.log10(rough))
        size = next(m * unit for m in (1, 2, 2.5, 5, 10) if m * unit >= rough)
        found = [
            float(f"{k * size:.12g}")
            for k in range(math.ceil(low / size), math.floor(high / size) + 1)
        ]
    slack = 1e-9 * (high - low)
    return [tick for tick in found if low - slack <= tick <= high + slack]


def text(value: Value) -> str:
    """A value with the digits that a person reads."""
    if isinstance(value, str):
        return maps.words(value)
    if math.isinf(value):
        return "∞"
    shown = f"{value:.{digits([value])}g}"
    return shown.replace("-", "−")


@dataclass(frozen=True)
class Doubt:
    """Which cells are not trusted; the cells may be larger than those of the map."""

    untrusted: Cells  # [y, x]
    x: NDArray[np.float64]  # places of their edges
    y: NDArray[np.float64]


@dataclass(frozen=True)
class Map:
    """A metric in the cells [y, x] of two axes."""

    view: View
    x: Axis
    y: Axis
    values: NDArray[np.floating[Any]]  # NaN where there is no number
    reasons: NDArray[np.uint8]  # index of REASONS
    label: str  # what the metric is
    unit: str
    converged: Cells | None = None  # None: the store does not say
    doubt: Doubt | None = None  # None: not known, or not yet
    fine: bool = True  # whether a finer one follows
    variables: Mapping[str, NDArray[Any]] = field(
        default_factory=dict
    )  # all that is known of cells

    @property
    def shares(self) -> dict[str, float]:
        """The part of the cells that have no number, by reason, and of those not trusted."""
        counts = np.bincount(self.reasons.ravel(), minlength=len(REASONS))
        found = {r: n / self.reasons.size for r, n in zip(REASONS, counts, strict=True) if r and n}
        if self.doubt is not None and self.doubt.untrusted.any():
            found["doubtful"] = float(self.doubt.untrusted.mean())
        return found

    def words(self, row: int, column: int) -> str:
        """Why a cell has no number; empty if it has one."""
        reason = REASONS[self.reasons[row, column]]
        return "" if reason == "infinite" else reason

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Row and column of the cell at a place."""
        return self.y.at(y), self.x.at(x)


def reasons(
    values: NDArray[Any], status: NDArray[Any], codes: Mapping[int, str]
) -> NDArray[np.uint8]:
    """Why cells have no number, from their status, whose codes have other numbers in a store."""
    found = np.zeros(values.shape, np.uint8)
    for code, reason in codes.items():
        found[status == code] = REASONS.index(reason)
    missing = (found == 0) & ~np.isfinite(values)
    found[missing] = np.where(
        np.isinf(values[missing]), REASONS.index("infinite"), REASONS.index("no value")
    )
    return found


def symbol(name: str) -> str:
    """The symbol of a field in HTML: K<sub>0</sub>; of anything else its name."""
    tex = maps.SYMBOLS.get(name, maps.words(name))
    for written, letter in (("\\tilde{x}", "x\u0303"), ("\\dot{x}", "\u1e8b"), ("\\sigma", "σ")):
        tex = tex.replace(written, letter)
    head, low, index = tex.strip("$").partition("_")
    rest = index.removeprefix("{").partition("}") if index.startswith("{") else (index, "", "")
    return f"{head}<sub>{rest[0]}</sub>{rest[2]}" if low and "$" in tex else tex.strip("$")


def unit(name: str) -> str:
    """The unit of a field or a metric for print: N·m/rad; empty for a number."""
    about = QUANTITIES.get(name) or METRICS.get(name) or {"unit": "s" if name in TIMES else "1"}
    return printed(about["unit"])


TIMES = ("dt", "t_end")


def printed(units: str) -> str:
    """A unit for print."""
    return "" if units in ("", "1") else units.replace("*", "·").replace("^2", "²")


def label(name: str) -> str:
    """Symbol and unit of a field in HTML."""
    return f"{symbol(name)} ({unit(name)})" if unit(name) else symbol(name)


Row = list[str]  # name, value, unit, and the value with all its digits


def row(name: str, value: float, units: str) -> Row:
    """A value of a cell in words."""
    if math.isinf(value):
        return [name, maps.INFINITE.get(name, "infinite"), "", repr(value)]
    if math.isnan(value):
        return [name, "no value", "", repr(value)]
    return [name, f"{value:.5g}".replace("-", "−"), printed(units), repr(value)]
