"""The cells of a store whose motions a shared file has."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweeps import maps
from sweeps.explore.motion import Motion, Scenario, motion
from sweeps.explore.signals import LOOKS, columns
from sweeps.explore.stored import Stored
from sweeps.explore.view import View
from sweeps.share.coarse import Copy, encoded

MOST_PINS = len(LOOKS["colour"])  # lines that a reader can tell apart


@dataclass(frozen=True)
class Pin:
    """A cell of a store and its motion."""

    name: str  # why it is pinned
    index: tuple[int, ...]  # in the store
    motion: Motion
    nmse: float  # of the cell
    note: str  # what differs from the store, or in the motion; or nothing

    @property
    def signals(self) -> dict[str, str]:
        """The signals of the motion as text."""
        return {name: encoded(values) for name, values in columns(self.motion).items()}


def choose(copy: Copy, view: View) -> list[tuple[str, tuple[int, ...]]]:
    """The best, the median and the worst trusted cell of the first map, as places in the store.

    Without error estimates all cells that have a number count. Where the first map has none, the
    whole copy is searched.
    """
    metric, shown = view.metric, copy.metrics[view.metric]
    good, first = shown.codes == 0, middle(copy)
    here = tuple(slice(None) if dim in (view.x, view.y) else i for dim, i in first.items())
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
        scenario = Scenario.of(source.grid, tuple(slice(i, i + 1) for i in index), source.dtype)
        one = motion(scenario)
        nmse = float(one.metrics.nmse)
        place = {
            dim: str(values[i]) if values.dtype.kind == "U" else float(values[i])
            for (dim, values), i in zip(source.coordinates.items(), index, strict=True)
        }
        rows = source.values(place, {})
        note = source.disagreement(place, rows, {"nmse": nmse}) or one.note
        pins.append(Pin(name, index, one, nmse, note))
    return pins
