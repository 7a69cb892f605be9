"""Hatches under and over the colours of a heatmap, and the legend that names them."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

from figures import style
from figures.cut import Cells as Of
from figures.planes import Plane
from sweeps import maps

LEGEND_BOX = 32  # point; a box of the legend and the spaces around it and its text
MOST_SHARES = 4  # panels with a share of each in the legend
COLOUR = "#21918c"  # the middle of the colours; 0.5 in a grey print
HATCH_CELLS = 400  # per side; finer hatch outlines are below one printed dot
# A dark line on a wider light line is visible on every colour, also in a grey print.
_OVERLAY: tuple[dict[str, Any], ...] = tuple(
    {
        "facecolor": "none",
        "hatch": style.UNTRUSTED,
        "hatchcolor": ink,
        "hatch_linewidth": width,
        "linewidth": 0,
    }
    for ink, width in (("white", 1.0), ("black", 0.4))
)

Handle = Artist | tuple[Artist, ...]  # of the legend
Edges = NDArray[np.float64]
Cells = NDArray[np.bool_]


def under(plane: Plane) -> Iterator[PathPatch]:
    """A patch for each reason why cells have no value, below the mesh, which is masked there."""
    kinds = np.zeros(plane.values.shape, dtype=np.int8)
    for kind, cells in enumerate(plane.special.values(), start=1):
        kinds[cells] = kind
    rows, columns, x, y = _sampled(plane)
    # a coarse cell shows any special cell in it, so that no masked cell stays blank
    coarse = np.maximum.reduceat(np.maximum.reduceat(kinds, rows, 0), columns, 1)
    sample = kinds[np.ix_(rows, columns)]
    coarse = np.where(sample > 0, sample, coarse)
    for kind, key in enumerate(plane.special, start=1):
        # antialiasing would draw seams between neighbouring rectangles
        yield PathPatch(outline(coarse == kind, x, y), zorder=0.5, antialiased=False, **_look(key))


def over(plane: Plane) -> Iterator[PathPatch]:
    """The hatch of the cells that are not trusted, above the mesh; their colours stay visible."""
    if plane.untrusted is None or not plane.untrusted.any():
        return
    rows, columns, x, y = _sampled(plane)
    # a coarse cell is what its first cell is, so that the hatch covers the true share of cells
    path = outline(plane.untrusted[np.ix_(rows, columns)], x, y)
    for zorder, look in zip((1.1, 1.2), _OVERLAY, strict=True):
        yield PathPatch(path, zorder=zorder, **look)


def _sampled(plane: Plane) -> tuple[NDArray[np.intp], NDArray[np.intp], Edges, Edges]:
    """At most about HATCH_CELLS rows and columns, and the edges between them."""
    rows, columns = (np.arange(0, n, max(1, n // HATCH_CELLS)) for n in plane.values.shape)
    x = np.append(plane.x.edges[columns], plane.x.edges[-1])
    y = np.append(plane.y.edges[rows], plane.y.edges[-1])
    return rows, columns, x, y


def outline(cells: Cells, x: Edges, y: Edges) -> Path:
    """The cells between edges `x` and `y` as one path: a rectangle for each run along x."""
    change = np.diff(np.pad(cells.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    row, start = np.nonzero(change == 1)
    stop = np.nonzero(change == -1)[1]
    left, right, low, high = x[start], x[stop], y[row], y[row + 1]
    corners = np.stack([left, low, right, low, right, high, left, high, left, low], axis=1)
    codes = np.tile([Path.MOVETO, *3 * [Path.LINETO], Path.CLOSEPOLY], len(row))
    return Path(corners.reshape(-1, 2), codes)


def _look(key: str) -> dict[str, Any]:
    hatch = style.HATCHES[key]
    return {
        "facecolor": hatch.face,
        "hatch": hatch.pattern,
        "hatchcolor": hatch.ink,
        "linewidth": 0,
    }


def bands(edges: Edges, special: Mapping[str, Cells]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Path and look of a band for each reason why places along an axis have no value.

    A band is from 0 to 1 across the axis.
    """
    for key, cells in special.items():
        yield outline(cells[None, :], edges, np.array([0.0, 1.0])), _look(key)


def legend_entries(parts: Sequence[Of]) -> dict[str, Handle]:
    """Text -> hatched box, for each hatch in the planes; the text has its share of each panel."""
    entries = special_entries(parts)
    if any(part.untrusted is not None and part.untrusted.any() for part in parts):
        # over a colour of the map: no box of a reason why cells have no value looks like it
        box = Patch(facecolor=COLOUR, edgecolor="black", linewidth=0.5)
        entries[doubt_text(parts)] = (box, *(Patch(**look) for look in _OVERLAY))
    return entries


def special_entries(parts: Sequence[Of]) -> dict[str, Handle]:
    """Text -> hatched box, for each reason why cells have no value."""
    edged = {"linewidth": 0.5, "edgecolor": "black"}
    return {
        special_text(key, parts): (Patch(**_look(key) | edged),)
        for key in style.HATCHES
        if any(key in part.special for part in parts)
    }


def special_text(key: str, parts: Sequence[Of]) -> str:
    """Why cells have no value, with their share of each panel."""
    metric = next((part.metric for part in parts if key in part.special), "")
    words = {"not run": "not run yet", "infinite": maps.INFINITE.get(metric, "infinite")}
    words["not trusted"] = "no value: too many scenarios are not trusted"
    words["no value"] = "none is best" if metric.startswith("best_") else "no value"
    cells = [part.special.get(key, np.zeros(1, bool)) for part in parts]
    return f"{words.get(key, key)} ({shares(cells)})"


def doubt_text(parts: Sequence[Of]) -> str:
    """When a cell is not trusted, with the share of each panel."""
    bounds = " or ".join(dict.fromkeys(part.trust_bound for part in parts if part.trust_bound))
    bounds = re.sub(r"(\w\w)_(\w)", r"\1 \2", bounds)  # a metric's name
    bounds = re.sub(r"\b(\w)_(\w+)", r"$\1_{\2}$", bounds)  # t_end, T_n
    return f"not trusted: {bounds} ({shares([part.untrusted for part in parts])})"


def legend_columns(entries: Iterable[str], width: float) -> int:
    """The most columns of a legend whose widest texts fit side by side into `width` inches."""
    widths = sorted((style.text_width(text, style.SMALL_SIZE) for text in entries), reverse=True)
    columns = int(width / 1.65)
    while columns > 1 and sum(widths[:columns]) + columns * LEGEND_BOX > 72 * width:
        columns -= 1
    return columns


def shares(panels: Sequence[Cells | None]) -> str:
    """Share of each panel's cells in percent, of all if they are many; a dash without estimates."""
    if len(panels) > MOST_SHARES:
        panels = [np.concatenate([cells.ravel() for cells in panels if cells is not None])]
    shares = ["–" if cells is None else style.share(float(cells.mean())) for cells in panels]
    return f"{', '.join(shares)} %"


def legend(
    fig: Figure, entries: Mapping[str, Handle], columns: int, held: str, panels_drawn: int
) -> None:
    """Draw the legend below the axes, where it covers no data, under what the picture holds."""
    shares = any(isinstance(handle, tuple) for handle in entries.values())
    lines = [held] if held else []
    each = "per panel, left to right" if panels_drawn <= MOST_SHARES else "of all panels"
    lines += [f"share of cells {each}"] if shares and panels_drawn > 1 else []
    if not (entries or lines):
        return
    handles: list[Any] = list(entries.values())
    drawn = fig.legend(
        handles,
        list(entries),
        handler_map={tuple: HandlerTuple(ndivide=1, pad=0)},
        loc="outside lower center",
        ncols=max(min(columns, len(entries)), 1),
        title="\n".join(lines) or None,
        frameon=False,
        handlelength=2.2,
        handleheight=1.3,
    )
    drawn.get_title().set_multialignment("center")
