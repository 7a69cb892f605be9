"""Maps drawn onto axes that a figure has laid out itself, with lines over them."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import PathPatch
from numpy.typing import NDArray

from figures import hatch, style
from figures.paper.look import label

# Below and above an even 0: blue and orange stay apart for colour-blind readers; here 0 is white,
# since lines and dots are drawn over it.
CHANGE = LinearSegmentedColormap.from_list(
    "change", ["#0a2463", "#3f6fb5", "#b9cde5", "#ffffff", "#f6d3a5", "#d9822b", "#7a3b00"]
)

GROWN = 0.1  # of a map of changes; a cell that is larger has dots
DOTS: dict[str, Any] = {"hatch": "....", "hatchcolor": "0.3", "linewidth": 0}


def rows(fig: Figure, heights: tuple[float, ...]) -> list[SubFigure]:
    """Parts of a figure, one below the other, each with its own legend."""
    return list(np.asarray(fig.subfigures(len(heights), 1, height_ratios=heights)).flat)


def edges(values: NDArray[np.float64], log: bool = True) -> NDArray[np.float64]:
    """Cell edges midway between the values, in the scale they are drawn in."""
    placed = np.log(values) if log else values
    middle = (placed[1:] + placed[:-1]) / 2
    ends = placed[:1] - (placed[1] - placed[0]) / 2, placed[-1:] + (placed[-1] - placed[-2]) / 2
    whole = np.concatenate([ends[0], middle, ends[1]])
    return np.exp(whole) if log else whole


def cells(
    ax: Axes, data: xr.DataArray, x: str, y: str, log: tuple[bool, bool] = (True, True), **kind: Any
) -> QuadMesh:
    """Draw `data` over its coordinates x and y; `kind` goes to pcolormesh."""
    sides = [
        edges(data[name].values.astype(float), of) for name, of in zip((x, y), log, strict=True)
    ]
    ax.set_xscale("log" if log[0] else "linear")
    ax.set_yscale("log" if log[1] else "linear")
    mesh = ax.pcolormesh(*sides, data.transpose(y, x).values, rasterized=True, **kind)
    ax.set_xlim(sides[0][0], sides[0][-1])
    ax.set_ylim(sides[1][0], sides[1][-1])
    ax.set_ylabel(label(y))
    return mesh


def grown(ax: Axes, data: xr.DataArray, x: str, y: str, log: tuple[bool, bool]) -> None:
    """Dots over the cells of a map of changes that are larger than GROWN."""
    sides = [
        edges(data[name].values.astype(float), of) for name, of in zip((x, y), log, strict=True)
    ]
    path = hatch.outline(data.transpose(y, x).values > GROWN, *sides)
    ax.add_artist(PathPatch(path, facecolor="none", **DOTS))


def over(ax: Axes, x: NDArray[Any], y: NDArray[Any], color: str = "white", **kind: Any) -> None:
    """A line over a map: dark edges make it seen on every colour."""
    ax.plot(x, y, color=color, lw=1.2, path_effects=style.EDGED, **kind)


def contour(
    ax: Axes,
    x: NDArray[Any],
    y: NDArray[Any],
    values: NDArray[Any],
    level: float,
    label: str,
    color: str = "white",
    ls: str = "-",
) -> None:
    """A contour of `values[y, x]` over a map, named in the legend."""
    lines = ax.contour(x, y, values, [level], colors=color, linewidths=1.2, linestyles=ls)
    lines.set_path_effects(style.EDGED)
    over(ax, np.array([]), np.array([]), color=color, ls=ls, label=label)
