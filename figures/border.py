"""The line of a heatmap between cells on either side of a border: nmse = 0.01, converged or not."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from figures.planes import Plane
from figures.style import EDGED
from sweeps import maps

WORDS = {
    "convergence_time": "converged or not",
    "contact_time": "touched or not",
    "contact_lost": "contact lost or never",
}
# More sides than this are the noise of cells that differ from all their neighbours: no border.
MOST = 50_000


@dataclass(frozen=True)
class Border:
    """The sides of cells that lie between inside and outside."""

    text: str
    sides: NDArray[np.float64]  # [side, end, (x, y)]


def between(plane: Plane) -> Border | None:
    """The border of a plane's metric; None if the metric has none, or no cell lies beyond it."""
    values, infinite = plane.values, plane.special.get("infinite")
    if plane.choices:
        return None
    level = maps.LEVELS.get(plane.metric)
    if level is not None:
        words = f"{plane.metric.replace('_', ' ')} = {level:g}"
        text, inside = WORDS.get(plane.metric, words), np.asarray(values.filled(np.inf) <= level)
        known = ~np.ma.getmaskarray(values)
    elif infinite is not None and plane.metric in WORDS:
        text, inside = WORDS[plane.metric], ~np.ma.getmaskarray(values)
        known = inside | infinite
    else:
        return None
    sides = maps.sides(inside, known, plane.x.edges, plane.y.edges)
    return Border(text, sides) if 0 < len(sides) <= MOST else None


def drawn(border: Border) -> Iterator[LineCollection]:
    """White on a wider dark line, so that it is seen on every colour."""
    for zorder, colour, width in ((1.5, "0.15", 2.4), (1.6, "white", 1.1)):
        look: dict[str, Any] = {"colors": colour, "linewidths": width, "capstyle": "projecting"}
        yield LineCollection(list(border.sides), rasterized=True, zorder=zorder, **look)


def legend_entry(border: Border) -> dict[str, Line2D]:
    """Text -> line."""
    return {border.text: Line2D([], [], color="white", lw=1.1, path_effects=EDGED)}
