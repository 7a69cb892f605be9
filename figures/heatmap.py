"""Heatmaps over two dimensions.

`draw` draws one plane; `panels` draws planes side by side, `grid` rows of them.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from figures import border, caption, colours, hatch, mesh, style, ticks
from figures.cut import PlotError
from figures.planes import Axis, Plane

FEW_CELLS = 10  # cells of a side up to which the cells carry numbers
SMALLEST_NUMBER = 6.2  # point; in a column of 3.4 inches it prints as 6
LABEL_ROOM, BAR_ROOM = 38, 50  # point; width of the labels of an axis, of the colour bar
PANEL_HEIGHT = 125  # point
# A line that a formula gives; its dark edges are seen on every colour.
GUIDE: dict[str, Any] = {"color": "white", "lw": 1.1, "ls": "--", "path_effects": style.EDGED}
Line = Callable[[Plane], tuple[NDArray[np.float64], NDArray[np.float64]]]  # x and y over a plane


def panels(items: Sequence[tuple[str, Plane]]) -> Figure:
    """A row of titled planes of one metric with one colour scale, one colour bar and one legend.

    The figure's title has the constants that all planes share, a panel's title has its own.
    Raises PlotError without a plane, or if the planes have different metrics.
    """
    if not items:
        raise PlotError("panels needs at least one plane.")
    metrics = dict.fromkeys(plane.metric for _, plane in items)
    if len(metrics) > 1:
        differ = ", ".join(metrics)
        raise PlotError(f"panels share one colour scale, but the metrics differ: {differ}.")
    return grid([items])


def grid(
    rows: Sequence[Sequence[tuple[str, Plane]]],
    *,
    width: float | None = None,
    row_height: float = 2.05,
    lines: Mapping[str, Line] | None = None,
) -> Figure:
    """Rows of titled planes; neighbouring rows of one metric share a colour scale and its bar.

    width: inches; default: a column of a paper for one panel, else a page
    row_height: inches, of a panel with the labels below it
    lines: words of the legend -> the dashed line that is drawn over each plane
    """
    planes = [plane for row in rows for _, plane in row]
    columns = len(rows[0])
    shared = all(_same(plane.y, planes[0].y) for plane in planes)
    if width is None:
        width = max(style.PAGE_WIDTH, 1.7 * columns) if columns > 1 else style.COLUMN_WIDTH
    labels = LABEL_ROOM * (1 if shared else columns)
    room = (72 * width - BAR_ROOM - labels) / columns - 8
    with style.look():
        head, titles, beside = caption.titles(rows, 72 * width - 10, room + 8)
        head = caption.of_choices(head, planes[0], 72 * width - 10)
        held = caption.held(planes, 72 * width - 10)
        entries = colours.choice_entries(planes[0]) | hatch.legend_entries(planes)
        for plane in planes:
            line = border.between(plane)
            entries |= border.legend_entry(line) if line else {}
        entries |= {text: Line2D([], [], **GUIDE) for text in lines or {}}
        entries |= mesh.legend_entry(planes)
        in_legend = hatch.legend_columns(entries, width)
        of_titles = [max(text.count("\n") for text in row) + bool(any(row)) for row in titles]
        lines_above = head.count("\n") + sum(of_titles) - 1
        small = math.ceil(len(entries) / in_legend) + 0.75 * (held.count("\n") + bool(held))
        height = 0.5 + row_height * len(rows) + 0.13 * lines_above + 0.15 * small
        fig = Figure(figsize=(width, height))
        axes = fig.subplots(len(rows), columns, sharey=shared, squeeze=False)
        drawn = zip(axes, rows, titles, beside, strict=True)
        for _, alike in itertools.groupby(drawn, key=lambda row: row[1][0][1].metric):
            group = list(alike)
            pool = colours.pool([plane for _, row, *_ in group for _, plane in row])
            for grid_row, row, texts, side in group:
                for ax, (_, plane), title, last in zip(grid_row, row, texts, rows[-1], strict=True):
                    coloured = _panel(ax, plane, pool, room)
                    ax.set_title(title)
                    for guide in (lines or {}).values():
                        ax.plot(*guide(plane), **GUIDE)
                    if shared and ax is not grid_row[0]:
                        ax.set_ylabel("")
                        ax.tick_params(labelleft=False)
                    if ax not in axes[-1] and _same(plane.x, last[1].x):
                        ax.set_xlabel("")
                        ax.tick_params(labelbottom=False)
                words = [style.fold(side, 72 * row_height - 30), grid_row[0].get_ylabel()]
                grid_row[0].set_ylabel("\n".join(text for text in words if text))
            if pool.size and not group[0][1][0][1].choices:
                beside_bar = [ax for grid_row, *_ in group for ax in grid_row]
                part, length = group[0][1][0][1], 72 * row_height * len(group)
                colours.bar(fig, coloured, beside_bar, part, pool, length)
        fig.suptitle(head)
        hatch.legend(fig, entries, in_legend, held, len(planes))
    return fig


def draw(plane: Plane) -> Figure:
    """One plane."""
    return panels([("", plane)])


def _same(one: Axis, other: Axis) -> bool:
    return one.label == other.label and np.array_equal(one.values, other.values)


def _panel(ax: Axes, plane: Plane, pool: NDArray[np.float64], room: float) -> QuadMesh:
    """Draw one plane into `ax`, about `room` points wide, in the colours of all values `pool`."""
    cmap, norm = colours.colour_map(plane), colours.norm(plane, pool)
    ax.set_xscale("log" if plane.x.scale == "log" else "linear")
    ax.set_yscale("log" if plane.y.scale == "log" else "linear")
    colours_drawn = ax.pcolormesh(
        plane.x.edges, plane.y.edges, plane.values, cmap=cmap, norm=norm, rasterized=True, zorder=1
    )
    for patch in (*hatch.under(plane), *hatch.over(plane)):
        ax.add_artist(patch)  # add_patch would compute limits from every corner
    for boxes in mesh.lines(plane, room, PANEL_HEIGHT):
        ax.add_collection(boxes, autolim=False)
    for drawn, axis, length in ((ax.xaxis, plane.x, room), (ax.yaxis, plane.y, PANEL_HEIGHT)):
        ticks.draw(drawn, axis, length)
    ax.set_xlim(plane.x.edges[0], plane.x.edges[-1])
    ax.set_ylim(plane.y.edges[0], plane.y.edges[-1])
    if max(plane.values.shape) <= FEW_CELLS and not plane.choices:
        _cell_numbers(ax, plane, cmap, norm, room)
    line = border.between(plane)
    for sides in border.drawn(line) if line else ():
        ax.add_collection(sides, autolim=False)
    return colours_drawn


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
