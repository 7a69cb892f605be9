"""Ticks of an axis: at its values if they are few, at categories that fit, or at round numbers."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axis import Axis as DrawnAxis
from matplotlib.axis import XAxis
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from figures import style
from figures.planes import Axis
from sweeps.spec.digits import digits

FEW = 6  # values of an axis up to which each gets a tick
STEPS = [1, 2, 2.5, 5, 10]  # of round numbers


def draw(drawn: DrawnAxis, axis: Axis, length: float) -> None:
    """Label an axis, and draw its ticks along `length` points."""
    drawn.set_label_text(axis.label)
    drawn.set_minor_locator(NullLocator())
    if axis.scale == "category":
        step = math.ceil(len(axis.values) / 12)
        shown = np.arange(0, len(axis.values), step)
        _named(drawn, axis, shown, _categories(axis.values[::step]), length)
        drawn.set_tick_params(length=0)
        return
    if len(axis.values) <= FEW:
        _named(drawn, axis, axis.values, numbers(axis.values), length)
        return
    values = _round(axis, FEW)
    # long labels need more room than FEW of them have
    for most in range(FEW - 1, 1, -1):
        places = length * axis.place(values)
        if not isinstance(drawn, XAxis) or not touching(places, numbers(values)):
            break
        values = _round(axis, most)
    drawn.set_ticks(values.tolist(), numbers(values))
    if axis.scale == "log":
        drawn.set_minor_locator(LogLocator(subs="auto"))
        drawn.set_minor_formatter(NullFormatter())


def numbers(values: Sequence[Any] | NDArray[Any]) -> list[str]:
    """Values in the digits that tell them apart."""
    n = digits(values)
    return [style.number(float(value), n) for value in values]


def _round(axis: Axis, most: int) -> NDArray[np.float64]:
    """Round numbers within an axis."""
    low, high = axis.edges[0], axis.edges[-1]
    values = np.asarray(MaxNLocator(most, steps=STEPS).tick_values(low, high))
    if axis.scale == "log":
        short = high < 50 * low
        decades = LogLocator(subs=(1.0, 2.0, 5.0) if short else (1.0,), numticks=most + 2)
        inside = _inside(np.asarray(decades.tick_values(low, high)), low, high)
        # within less than a decade there may be one such number, or none
        values = inside if len(inside) > 1 else values
    return _inside(values, low, high)


def _inside(values: NDArray[Any], low: float, high: float) -> NDArray[np.float64]:
    slack = 1e-9 * (high - low)
    return np.asarray(values[(values >= low - slack) & (values <= high + slack)], np.float64)


def _named(
    drawn: DrawnAxis, axis: Axis, values: NDArray[Any], labels: list[str], length: float
) -> None:
    """Ticks with given labels. Labels that would touch are slanted below the axis, or left out."""
    places = length * axis.place(values)
    slanted: dict[str, Any] = {}
    if isinstance(drawn, XAxis) and touching(places, labels):
        if axis.scale == "category":
            labels = [label.replace(" ", "\n") for label in labels]
        if touching(places, labels):
            slanted = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
    if slanted or not isinstance(drawn, XAxis):
        last = -math.inf
        for position, place in enumerate(places):
            if place - last < 1.2 * style.FONT_SIZE:
                labels[position] = ""
            else:
                last = place
    drawn.set_ticks(values.tolist(), labels, **slanted)


def touching(places: NDArray[Any], labels: list[str]) -> bool:
    """Whether labels at places (points) along an axis would touch."""
    widths = [style.text_width(label, style.FONT_SIZE) for label in labels]
    return bool(np.any(np.diff(places) < [(a + b) / 2 + 3 for a, b in itertools.pairwise(widths)]))


def _categories(values: NDArray[Any]) -> list[str]:
    return numbers(values) if values.dtype.kind == "f" else [style.words(str(v)) for v in values]
