"""Heatmaps of one metric over two dimensions.

`draw` draws one plane; `panels` draws planes side by side.
"""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from figures import border, caption, colours, hatch, mesh, style, ticks
from figures.cut import PlotError
from figures.planes import Axis, Plane

FEW_CELLS = 10  # cells of a side up to which the cells carry numbers
SMALLEST_NUMBER = 6.2  # point; in a column of 3.4 inches it prints as 6
LABEL_ROOM, BAR_ROOM = 38, 50  # point; width of the labels of an axis, of the colour bar
PANEL_HEIGHT = 125  # point


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
    with style.look():
        head, titles = caption.titles(items, 72 * width - 10, room + 8)
        head = caption.of_choices(head, planes[0], 72 * width - 10)
        held = caption.held(planes, 72 * width - 10)
        entries = colours.choice_entries(planes[0]) | hatch.legend_entries(planes)
        borders = [border.between(plane) for plane in planes]
        for line in borders:
            entries |= border.legend_entry(line) if line else {}
        entries |= mesh.legend_entry(planes)
        columns = hatch.legend_columns(entries, width)
        lines = head.count("\n") + max(text.count("\n") for text in titles)
        small = math.ceil(len(entries) / columns) + 0.75 * (held.count("\n") + bool(held))
        fig = Figure(figsize=(width, 2.55 + 0.13 * lines + 0.15 * small))
        grid = list(fig.subplots(1, len(items), sharey=shared, squeeze=False)[0])
        pool = colours.pool(planes)
        cmap, norm = colours.colour_map(planes[0]), colours.norm(planes[0], pool)
        for ax, plane, line, title in zip(grid, planes, borders, titles, strict=True):
            coloured = _panel(ax, plane, cmap, norm, room)
            ax.set_title(title)
            for lines_drawn in border.drawn(line) if line else ():
                ax.add_collection(lines_drawn, autolim=False)
            if shared and ax is not grid[0]:
                ax.set_ylabel("")
                ax.tick_params(labelleft=False)
        fig.suptitle(head)
        if pool.size and not planes[0].choices:
            colours.bar(fig, coloured, grid, planes[0], pool)
        hatch.legend(fig, entries, columns, held, len(planes))
    return fig


def draw(plane: Plane) -> Figure:
    """One plane."""
    return panels([("", plane)])


def _same(one: Axis, other: Axis) -> bool:
    return one.label == other.label and np.array_equal(one.values, other.values)


def _panel(ax: Axes, plane: Plane, cmap: Colormap, norm: Normalize, room: float) -> QuadMesh:
    """Draw one plane into `ax`, about `room` points wide."""
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
