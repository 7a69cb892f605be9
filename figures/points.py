"""A metric along one dimension of a store: a line over its values, or a dot for each scenario.

Dots stand over a field that varies along the dimension, as the fields of a random design do; with
two such fields the metric is their colour.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from figures import caption, colours, hatch, style, ticks
from figures.cut import (
    Cells,
    PlotError,
    Wanted,
    cells,
    cut,
    require_dimension,
    require_metric,
    scale_of,
    symbol,
    units,
    with_units,
)
from figures.planes import Axis, axis
from sweeps import maps
from sweeps.spec.digits import digits

FEW_MARKERS = 60  # values of a line up to which each has a marker
MARGIN = 0.04  # of the axis, beyond the outermost dots
# Dark rims: the light end of the colours is hardly seen on white.
EDGE: dict[str, Any] = {"linewidths": 0.25, "edgecolors": "0.3"}
RIM = [withStroke(linewidth=1.2, foreground="0.3")]
LINE, DOUBT = "#0072B2", "0.45"  # trusted, and not trusted
HEIGHT = 2.5  # inch, without title and legend
ROOM, PANEL_HEIGHT = 205, 125  # point, lengths of the axes


@dataclass(frozen=True)
class Points(Cells):
    """One metric along a dimension, and where each value stands."""

    x: Axis
    y: Axis | None  # None: the metric is the height
    own: bool  # x is the dimension itself

    @property
    def joined(self) -> bool:
        """Whether a line joins the values."""
        return self.own and self.x.scale != "category" and not self.choices


def select(
    data: xr.Dataset,
    *,
    x: str | None = None,
    y: str | None = None,
    metric: str = "nmse",
    at: Wanted | None = None,
) -> Points:
    """Read a metric over a dimension `x`, or over fields `x` and `y` that vary along one.

    `at` fixes other dimensions (`cut`). Raises PlotError if the store has no such values.
    """
    require_metric(metric, data)
    dims = [str(dim) for dim in data[metric].dims]
    if x is None and len(dims) == 1:
        fields = [str(c.name) for c in data.coords.values() if c.dims == (dims[0],)]
        x = dims[0] if dims[0] in fields or not fields else None
    if x is None:
        fields = [str(c.name) for dim in dims for c in data.coords.values() if c.dims == (dim,)]
        raise PlotError(f"Name the horizontal axis: `--x` one of {', '.join(fields or dims)}.")
    along = _dimension(x, data, metric)
    if y is not None and _dimension(y, data, metric) != along:
        raise PlotError(f"'{x}' and '{y}' vary along two dimensions: draw {' and '.join(dims)}.")
    if x == y:
        raise PlotError(f"x and y must differ, but both are '{x}'.")
    part = cut(data, (along,), metric, at or {})
    if x == along and scale_of(_coordinate(part, x)) != "category":
        part = part.sortby(x)
    drawn = cells(part, metric)
    return Points(
        **vars(drawn) | {"held": (*drawn.held, *_varying(part, along, {along, x, y}))},
        x=axis(_coordinate(part, x)) if x == along else _spread(part, x),
        y=None if y is None else _spread(part, y),
        own=x == along,
    )


def _varying(part: xr.Dataset, dim: str, drawn: set[str | None]) -> Iterator[str]:
    """The fields that vary with what is drawn, and are not drawn themselves."""
    for name, coordinate in part.coords.items():
        values = coordinate.values
        if name in drawn or coordinate.dims != (dim,) or values.min() == values.max():
            continue
        ends = (values.min(), values.max())
        low, high = (style.number(end, digits(ends)) for end in ends)
        unit = style.units_text(units(coordinate))
        yield f"varying too: {symbol(coordinate)} = {low} to {high} {unit}".strip()


def _dimension(name: str, data: xr.Dataset, metric: str) -> str:
    """The dimension that a field varies along."""
    if name in data.coords and data[name].ndim == 1:
        return str(data[name].dims[0])
    require_dimension(name, data, metric)
    return name


def _coordinate(part: xr.Dataset, name: str) -> xr.DataArray:
    """A coordinate; `scenario` has none but its numbers."""
    return part[name] if name in part.coords else part[name].rename(name)


def _spread(part: xr.Dataset, name: str) -> Axis:
    """An axis with room for all values, on the scale of their range in the sweep file."""
    coordinate = part[name]
    values = coordinate.values.astype(float)
    low, high = float(values.min()), float(values.max())
    sample = json.loads(part.attrs.get("sweep", "{}")).get("sample") or {"ranges": {}}
    ranges, wide = sample["ranges"].get(name), low > 0 and high > 10**1.5 * low
    log = "log" in ranges if ranges else wide
    label = with_units(symbol(coordinate), coordinate)
    if log:
        room = (high / low) ** MARGIN if high > low else 1.1
        return Axis(name, label, "log", values, np.array([low / room, high * room]))
    room = MARGIN * (high - low) or 0.1 * (abs(high) or 1.0)
    return Axis(name, label, "linear", values, np.array([low - room, high + room]))


def draw(points: Points) -> Figure:
    """A line with markers, or dots; what has no value, or is not trusted, has a look of its own."""
    with style.look():
        width = 72 * style.COLUMN_WIDTH - 10
        head, *_ = caption.titles([[("", points)]], width, width)
        head = head if points.y is None else caption.of_choices(head, points, width)
        held = caption.held([points], width)
        pool = colours.pool([points])
        norm = colours.norm(points, pool)
        fig = Figure()
        ax = fig.subplots()
        ax.set_xscale("log" if points.x.scale == "log" else "linear")
        if points.y is None:
            entries = _heights(ax, points, isinstance(norm, LogNorm))
            colours.whole_ticks(ax.yaxis, points, norm)
        else:
            ax.set_yscale("log" if points.y.scale == "log" else "linear")
            entries = _colours(fig, ax, points, points.y, pool)
        ticks.draw(ax.xaxis, points.x, ROOM)
        ax.set_xlim(points.x.edges[0], points.x.edges[-1])
        fig.suptitle(head)
        columns = hatch.legend_columns(entries, style.COLUMN_WIDTH)
        hatch.legend(fig, entries, columns, held, 1)
        small = math.ceil(len(entries) / columns) + 0.75 * (held.count("\n") + bool(held))
        fig.set_size_inches(style.COLUMN_WIDTH, HEIGHT + 0.13 * head.count("\n") + 0.15 * small)
    return fig


def _heights(ax: Axes, points: Points, log: bool) -> dict[str, hatch.Handle]:
    """The metric as height."""
    x = _places(points)
    y = points.values.filled(np.nan)
    doubt = np.zeros(y.shape, bool) if points.untrusted is None else points.untrusted
    entries: dict[str, hatch.Handle] = {}
    if points.joined:
        ax.plot(x, y, color=LINE, lw=1.0, zorder=2)
    size = 3.5 if points.joined else 2.5
    refined = points.simulated is not None
    own = points.simulated if points.simulated is not None else np.ones(y.shape, bool)
    if refined:  # between the markers the line has steps
        marker: dict[str, Any] = {"marker": "o", "color": LINE, "ms": size / 2, "mew": 0}
        ax.plot(x[own & ~doubt], y[own & ~doubt], ls="", zorder=3, **marker)
        share = style.share(float(own.mean()))
        entries[f"{share} % of cells simulated; between them a value from beside"] = Line2D(
            [], [], lw=1.0, **marker
        )
        doubt = doubt & own
    elif not points.joined or y.size <= FEW_MARKERS:
        ax.plot(x[~doubt], y[~doubt], "o", color=LINE, ms=size, mew=0, zorder=3)
    if doubt.any():
        look: dict[str, Any] = {"mfc": "white", "color": DOUBT, "mew": 0.7, "ms": size}
        ax.plot(x[doubt], y[doubt], "o", zorder=2.5 if not points.joined else 3, **look)
        entries[hatch.doubt_text([points])] = Line2D([], [], ls="", marker="o", **look)
    level = maps.LEVELS.get(points.metric)
    if level:
        dashes: dict[str, Any] = {"color": DOUBT, "lw": 0.6, "ls": (0, (4, 2))}
        ax.axhline(level, zorder=1, **dashes)
        entries[f"{points.metric} = {level:g}"] = Line2D([], [], **dashes)
    values = points.values.compressed()
    if log:
        positive = values[values > 0]
        # a log scale has no place for an exact zero, and a point may not vanish
        kind = {"linthresh": positive.min()} if positive.size < values.size else {}
        ax.set_yscale("symlog" if kind else "log", **kind)
    ax.set_ylabel(style.fold(points.label, 150))
    if points.choices:
        ax.set_yticks(range(1, len(points.choices) + 1), points.choices)
        ax.set_ylim(0.5, len(points.choices) + 0.5)
    if points.own:
        for path, look in hatch.bands(points.x.edges, points.special):
            across = ax.get_xaxis_transform()
            ax.add_artist(PathPatch(path, transform=across, zorder=0.5, **look))
        return hatch.special_entries([points]) | entries
    return _rug(ax, points, x) | entries


def _colours(
    fig: Figure, ax: Axes, points: Points, side: Axis, pool: NDArray[np.float64]
) -> dict[str, hatch.Handle]:
    """The metric as colour."""
    x, y, doubt = _places(points), side.values.astype(float), points.untrusted
    known = ~np.ma.getmaskarray(points.values)
    doubt = np.zeros(known.shape, bool) if doubt is None else doubt & known
    entries: dict[str, hatch.Handle] = {**colours.choice_entries(points)}
    kind: dict[str, Any] = {
        "cmap": colours.colour_map(points),
        "norm": colours.norm(points, pool),
        "rasterized": True,
    }
    sure = known & ~doubt
    drawn = ax.scatter(x[sure], y[sure], c=points.values[sure], s=7, **EDGE, **kind)
    if doubt.any():
        colour = kind["cmap"](kind["norm"](points.values[doubt]))
        look: dict[str, Any] = {"facecolors": "none", "path_effects": RIM, "rasterized": True}
        ax.scatter(x[doubt], y[doubt], s=7, linewidths=0.7, edgecolors=colour, **look)
        ring: dict[str, Any] = {"marker": "o", "mfc": "none", "mec": DOUBT, "mew": 0.7, "ms": 2.7}
        entries[hatch.doubt_text([points])] = Line2D([], [], ls="", **ring)
    for key, at in points.special.items():
        mark = _mark(key)
        ax.plot(x[at], y[at], zorder=0.9, **mark)
        entries[hatch.special_text(key, [points])] = Line2D([], [], **mark)
    ticks.draw(ax.yaxis, side, PANEL_HEIGHT)
    ax.set_ylim(side.edges[0], side.edges[-1])
    if pool.size and not points.choices:
        colours.bar(fig, drawn, [ax], points, pool)
    return entries


def _places(points: Points) -> NDArray[np.float64]:
    if points.x.scale == "category":
        return np.arange(len(points.x.values), dtype=float)
    return points.x.values.astype(float)


def _mark(key: str) -> dict[str, Any]:
    return {
        "ls": "",
        "marker": style.MARKS[key],
        "ms": 3.5,
        "mew": 0.7,
        "mfc": "none",
        "color": "0.15",
    }


def _rug(ax: Axes, points: Points, x: NDArray[np.float64]) -> dict[str, hatch.Handle]:
    """Scenarios without a value, as marks along the upper end of the axis."""
    entries: dict[str, hatch.Handle] = {}
    for i, (key, at) in enumerate(points.special.items()):
        mark, top = _mark(key), np.full(int(at.sum()), 1.03 + 0.05 * i)
        ax.plot(x[at], top, transform=ax.get_xaxis_transform(), clip_on=False, **mark)
        entries[hatch.special_text(key, [points])] = Line2D([], [], **mark)
    return entries
