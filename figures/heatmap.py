"""Heatmaps of one metric over two dimensions.

`plot` cuts one plane out of a store and draws it; `panels` draws planes side by side.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis as DrawnAxis
from matplotlib.axis import XAxis
from matplotlib.collections import QuadMesh
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
)
from numpy.typing import NDArray

from figures import hatch, style
from figures.planes import Axis, Plane, PlotError, select
from sweeps.store.format import ERRORS

LOG_METRICS = ("nmse", "nmse_tail", *ERRORS)  # the paper compares decades
LINEAR_METRICS = ("convergence_time", "contact_time")
SIGNED_METRICS = ("steady_error",)

FEW_TICKS = 6  # values of an axis up to which each gets a tick
FEW_CELLS = 10  # cells of a side up to which the cells carry numbers
MAX_DECADES = 8  # of colours: further below, nmse is rounding in float32
SMALLEST_NUMBER = 4.7  # point; nobody can read smaller digits in print
LABEL_ROOM, BAR_ROOM = 38, 50  # point; width of the labels of an axis, of the colour bar
PANEL_HEIGHT = 125  # point


def plot(
    data: xr.Dataset,
    *,
    x: str,
    y: str,
    metric: str = "nmse",
    at: Mapping[str, float | str] | None = None,
) -> Figure:
    """Heatmap of `metric` over dimensions `x` and `y`; `at` fixes the others (`planes.select`)."""
    return panels([("", select(data, x=x, y=y, metric=metric, at=at))])


def panels(items: Sequence[tuple[str, Plane]]) -> Figure:
    """A row of titled planes of one metric with one colour scale, one colour bar and one legend.

    The figure's title has the constants that all planes share, a panel's title has its own.
    Raises PlotError without a plane, or if the planes have different metrics.
    """
    if not items:
        raise PlotError("panels needs at least one plane.")
    planes = [plane for _, plane in items]
    if len({plane.metric for plane in planes}) > 1:
        metrics = ", ".join(dict.fromkeys(plane.metric for plane in planes))
        raise PlotError(f"panels share one colour scale, but the metrics differ: {metrics}.")
    shared = all(_same(plane.y, planes[0].y) for plane in planes)
    width = max(style.PAGE_WIDTH, 1.7 * len(items)) if len(items) > 1 else style.COLUMN_WIDTH
    labels = LABEL_ROOM * (1 if shared else len(items))
    room = (72 * width - BAR_ROOM - labels) / len(items) - 8
    head, titles = _titles(items, 72 * width - 10, room + 8)
    with rc_context(style.RC):
        entries = hatch.legend_entries(planes)
        columns = hatch.legend_columns(entries, width)
        lines = head.count("\n") + max(text.count("\n") for text in titles)
        height = 2.55 + 0.13 * lines + 0.15 * math.ceil(len(entries) / columns)
        fig = Figure(figsize=(width, height))
        grid = list(fig.subplots(1, len(items), sharey=shared, squeeze=False)[0])
        cmap, norm, pool = _colours(planes)
        for ax, plane, title in zip(grid, planes, titles, strict=True):
            mesh = _panel(ax, plane, cmap, norm, room)
            ax.set_title(title)
            if shared and ax is not grid[0]:
                ax.set_ylabel("")
                ax.tick_params(labelleft=False)
        fig.suptitle(head)
        if pool.size:
            _colour_bar(fig, mesh, grid, planes[0].label, pool)
        if entries:
            hatch.legend(fig, entries, columns, len(planes))
    return fig


def _same(one: Axis, other: Axis) -> bool:
    return one.label == other.label and np.array_equal(one.values, other.values)


def _titles(
    items: Sequence[tuple[str, Plane]], width: float, panel_width: float
) -> tuple[str, list[str]]:
    """Title of the figure and of each panel, in lines of `width` and `panel_width` points."""
    planes = [plane for _, plane in items]
    common = [text for text in planes[0].fixed if all(text in plane.fixed for plane in planes)]
    names = {plane.name for plane in planes}
    head = [style.fold(planes[0].name, width)] if len(names) == 1 else []
    titles = []
    for title, plane in items:
        own = [text for text in plane.fixed if text not in common]
        lines = [title, plane.name if len(names) > 1 else ""]
        lines = [style.fold(line, panel_width) for line in lines if line]
        titles.append("\n".join([*lines, *([style.wrap(own, panel_width)] if own else [])]))
    head += [style.wrap(common, width)] if common else []
    return "\n".join(line for line in head if line), titles


def _colours(planes: Sequence[Plane]) -> tuple[Colormap, Normalize, NDArray[np.float64]]:
    """Colour map, scale and all values of the planes."""
    metric = planes[0].metric
    pool = np.concatenate([plane.values.compressed() for plane in planes])
    cmap = style.DIVERGING if metric in SIGNED_METRICS else colormaps[style.SEQUENTIAL]
    return cmap, _norm(metric, pool), pool


def _norm(metric: str, pool: NDArray[np.float64]) -> Normalize:
    """A scale between round numbers around the middle 98 % of the values."""
    positive = pool[pool > 0]
    free = metric not in LINEAR_METRICS + SIGNED_METRICS and 0 < positive.size == pool.size
    log = metric in LOG_METRICS or (free and positive.max() > 100 * positive.min())
    if log and positive.size:
        low, high = np.log10(np.quantile(positive, [0.01, 0.99], method="inverted_cdf"))
        top = max(math.ceil(high), math.floor(low) + 1)
        bottom = max(math.floor(low), top - MAX_DECADES)
        # clip: an exact zero gets the lowest colour; without it the cell would be blank
        return LogNorm(10.0**bottom, 10.0**top, clip=True)
    if not pool.size:
        return Normalize(0, 1)
    low, high = np.quantile(pool, [0.01, 0.99], method="inverted_cdf")
    if metric in SIGNED_METRICS:
        high = max(abs(low), abs(high))
        low = -high
    if high - low <= 1e-4 * max(abs(low), abs(high)):  # all values are equal, or nearly
        low, high = low - 0.1 * (abs(low) or 1.0), high + 0.1 * (abs(high) or 1.0)
        low = 0.0 if metric in ERRORS else low  # an error is not negative
    ticks = MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    return Normalize(ticks[0], ticks[-1])


def _panel(ax: Axes, plane: Plane, cmap: Colormap, norm: Normalize, room: float) -> QuadMesh:
    """Draw one plane into `ax`, about `room` points wide."""
    ax.set_xscale("log" if plane.x.scale == "log" else "linear")
    ax.set_yscale("log" if plane.y.scale == "log" else "linear")
    mesh = ax.pcolormesh(
        plane.x.edges, plane.y.edges, plane.values, cmap=cmap, norm=norm, rasterized=True, zorder=1
    )
    for patch in (*hatch.under(plane), *hatch.over(plane)):
        ax.add_artist(patch)  # add_patch would compute limits from every corner
    for drawn, axis, length in ((ax.xaxis, plane.x, room), (ax.yaxis, plane.y, PANEL_HEIGHT)):
        _ticks(drawn, axis, length)
        drawn.set_label_text(axis.label)
    ax.set_xlim(plane.x.edges[0], plane.x.edges[-1])
    ax.set_ylim(plane.y.edges[0], plane.y.edges[-1])
    if max(plane.values.shape) <= FEW_CELLS:
        _cell_numbers(ax, plane, cmap, norm, room)
    return mesh


def _ticks(drawn: DrawnAxis, axis: Axis, length: float) -> None:
    """Ticks at the values of a short axis, at categories that fit, otherwise at round numbers."""
    drawn.set_minor_locator(NullLocator())
    if axis.scale == "category":
        step = math.ceil(len(axis.values) / 12)
        places = np.arange(0, len(axis.values), step)
        _named_ticks(drawn, axis, places, [_category(v) for v in axis.values[::step]], length)
        drawn.set_tick_params(length=0)
        return
    if len(axis.values) <= FEW_TICKS:
        labels = [style.number(float(value)) for value in axis.values]
        _named_ticks(drawn, axis, axis.values, labels, length)
        return
    drawn.set_major_formatter(FuncFormatter(lambda value, _: style.number(value)))
    if axis.scale == "log":
        short = axis.edges[-1] < 50 * axis.edges[0]
        drawn.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if short else (1.0,)))
        drawn.set_minor_locator(LogLocator(subs="auto"))
        drawn.set_minor_formatter(NullFormatter())
    else:
        drawn.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))


def _named_ticks(
    drawn: DrawnAxis, axis: Axis, values: NDArray[Any], labels: list[str], length: float
) -> None:
    """Ticks with given labels. Labels that would touch are slanted below the axis, or left out."""
    places = length * axis.place(values)
    slanted: dict[str, Any] = {}
    if isinstance(drawn, XAxis) and _touching(places, labels):
        labels = [label.replace("_", "\n") for label in labels]
        if _touching(places, labels):
            slanted = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
    if slanted or not isinstance(drawn, XAxis):
        last = -math.inf
        for position, place in enumerate(places):
            if place - last < 1.2 * style.FONT_SIZE:
                labels[position] = ""
            else:
                last = place
    drawn.set_ticks(values.tolist(), labels, **slanted)


def _touching(places: NDArray[Any], labels: list[str]) -> bool:
    widths = [style.text_width(label, style.FONT_SIZE) for label in labels]
    return bool(np.any(np.diff(places) < [(a + b) / 2 + 3 for a, b in itertools.pairwise(widths)]))


def _category(value: Any) -> str:
    return style.number(float(value)) if isinstance(value, np.floating) else str(value)


def _cell_numbers(ax: Axes, plane: Plane, cmap: Colormap, norm: Normalize, room: float) -> None:
    """Print each value in its cell, black or white, unless the digits would be too small."""
    digits, size, upright = _fit(plane, plane.values.compressed().tolist(), room)
    if size < SMALLEST_NUMBER:
        return
    x, y = (_centres(axis) for axis in (plane.x, plane.y))
    for row, column in np.argwhere(~np.ma.getmaskarray(plane.values)):
        value = plane.values[row, column]
        red, green, blue, _ = colour = cmap(norm(value))
        cover = {"facecolor": colour, "linewidth": 0, "pad": 1}  # keeps the hatch off the digits
        dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
        ax.text(
            x[column],
            y[row],
            style.cell_number(value, digits),
            color="white" if dark else "black",
            fontsize=size,
            rotation=90 if upright else 0,
            ha="center",
            va="center" if upright else "center_baseline",
            bbox=cover if plane.untrusted is not None and plane.untrusted[row, column] else None,
        )


def _fit(plane: Plane, values: list[float], room: float) -> tuple[int, float, bool]:
    """Digits, font size (points) and whether upright: the first readable choice, or the last."""
    wide = room * float(np.diff(plane.x.place(plane.x.edges)).min())
    high = PANEL_HEIGHT * float(np.diff(plane.y.place(plane.y.edges)).min())
    for upright, digits in ((False, 2), (False, 1), (True, 2), (True, 1)):
        along, across = (high, wide) if upright else (wide, high)
        em = max((style.text_width(style.cell_number(v, digits), 1) for v in values), default=1)
        size = min(style.SMALL_SIZE, 0.92 * along / em, 0.8 * across)
        if size >= SMALLEST_NUMBER:
            break
    return digits, size, upright


def _centres(axis: Axis) -> list[float]:
    low, high = axis.edges[:-1], axis.edges[1:]
    return list(np.sqrt(low * high) if axis.scale == "log" else (low + high) / 2)


def _colour_bar(
    fig: Figure, mesh: QuadMesh, axes: list[Axes], label: str, pool: NDArray[np.float64]
) -> None:
    """One colour bar for the row, with an arrow at an end that values exceed."""
    norm = mesh.norm
    below, above = pool.min() < norm.vmin, pool.max() > norm.vmax
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    bar = fig.colorbar(mesh, ax=axes, extend=extend, fraction=0.08, pad=0.02, aspect=22)
    bar.outline.set_linewidth(0.5)
    bar.set_label(style.fold(label, 150))
    bar.minorticks_off()
