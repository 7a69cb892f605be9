"""The boxes of a refined grid over a heatmap: what was simulated stands at their corners."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patches import Patch

from figures import hatch
from figures.planes import Plane

LEAST = 3.0  # point; the lines of smaller boxes would cover their colours


def lines(plane: Plane, room: float, height: float) -> Iterator[LineCollection]:
    """The outlines of the boxes of a plane that is `room` by `height` points large."""
    if not plane.levels:
        return
    x, y = (axis.values.astype(float) for axis in (plane.x, plane.y))
    for level in range(plane.levels):
        step = 1 << (plane.levels - level)
        if min(room * step / len(x), height * step / len(y)) < LEAST:
            return
        assert plane.level is not None
        # the cell in the middle of a box lies in no other
        row, column = np.nonzero(plane.level[step // 2 :: step, step // 2 :: step] == level)
        left, right = x[column * step], x[(column + 1) * step]
        low, high = y[row * step], y[(row + 1) * step]
        corners = [(left, low), (right, low), (right, high), (left, high), (left, low)]
        outlines = np.stack([np.stack(corner, -1) for corner in corners], 1)
        look: dict[str, Any] = {"colors": "white", "linewidths": 0.25, "alpha": 0.6}
        yield LineCollection(list(outlines), rasterized=True, zorder=1.3, **look)


def legend_entry(planes: Sequence[Plane]) -> dict[str, hatch.Handle]:
    """Text -> boxes, if one of the planes is refined; the text has the share of each panel."""
    simulated = [plane.simulated for plane in planes]
    if all(cells is None for cells in simulated):
        return {}
    boxes: dict[str, Any] = {"hatch": "++", "hatchcolor": "white", "hatch_linewidth": 0.4}
    text = f"simulated at corners ({hatch.shares(simulated)}); elsewhere the nearest corner"
    return {text: (Patch(facecolor="0.5", lw=0, **boxes),)}
