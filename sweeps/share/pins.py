"""The cells of a store whose motions a shared file has."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweeps import maps
from sweeps.explore.cells import Row
from sweeps.explore.motion import Motion, Scenario, motion
from sweeps.explore.motion_figures import COLUMNS, LOOKS, columns
from sweeps.explore.stored import Stored
from sweeps.share.coarse import Copy, encoded

MOST_PINS = len(LOOKS)  # lines that a reader can tell apart


@dataclass(frozen=True)
class Pin:
    """A cell of a store, its motion, and what the store has of it."""

    name: str  # why it is pinned
    index: tuple[int, ...]  # in the store
    motion: Motion
    values: list[Row]
    note: str  # what differs between the store and this program; or nothing

    @property
    def signals(self) -> dict[str, str]:
        """The signals of the motion as text."""
        return {n: encoded(v) for n, v in columns(self.motion).items() if n in COLUMNS}


def choose(source: Stored, copy: Copy, metric: str) -> list[tuple[str, tuple[int, ...]]]:
    """The best, the median and the worst trusted cell of the first map, as places in the store.

    Without error estimates all cells that have a number count. Where the first map has none, the
    whole copy is searched.
    """
    shown, axes = copy.metrics[metric], (source.start.x, source.start.y)
    good, first = shown.codes == 0, middle(copy)
    here = tuple(slice(None) if dim in axes else i for dim, i in first.items())
    if good[here].any():
        on_map = np.zeros(good.shape, bool)
        on_map[here] = True
        good &= on_map
    cells = np.flatnonzero(good)
    if not cells.size:
        return []
    values = shown.values.ravel()[cells]
    if metric in maps.SIGNED_METRICS:
        values = np.abs(values)
    order = cells[np.argsort(values, kind="stable")]
    found: dict[tuple[int, ...], str] = {}
    for name, place in (("best", 0), ("median", order.size // 2), ("worst", order.size - 1)):
        cell = np.unravel_index(order[place], good.shape)
        index = tuple(int(k[i]) for k, i in zip(copy.kept.values(), cell, strict=True))
        found.setdefault(index, f"{name} {metric}")
    return [(name, index) for index, name in found.items()]


def middle(copy: Copy) -> dict[str, int]:
    """The middle of each dimension: where the first map is cut."""
    return {dim: len(kept) // 2 for dim, kept in copy.kept.items()}


def simulated(source: Stored, cells: Sequence[tuple[str, tuple[int, ...]]]) -> list[Pin]:
    """The pins at some cells, by the program that computes sweeps."""
    pins = []
    for name, index in cells:
        block = tuple(slice(i, i + 1) for i in index)
        one = motion(Scenario.of(source.grid, block, source.dtype))
        place = {
            dim: source.axes[dim].value(source.axes[dim].index(_value(values[i])))
            for (dim, values), i in zip(source.coordinates.items(), index, strict=True)
        }
        rows = source.values(place, {})
        note = source.disagreement(rows, {"nmse": float(one.metrics.nmse)})
        pins.append(Pin(name, index, one, rows, note))
    return pins


def _value(value: Any) -> float | str:
    return str(value) if isinstance(value, str) else float(value)
