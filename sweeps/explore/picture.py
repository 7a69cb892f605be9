"""A map as a Bokeh figure, which knows nothing of a server.

Both sides have the length 1, whatever an axis is; its texts are ticks at places. Titles and labels
are text of the page around it.
"""

import math
from typing import Any, Literal

import numpy as np
from bokeh.models import (
    ColumnDataSource,
    FixedTicker,
    ImageRGBA,
    LinearAxis,
    Plot,
    Quad,
    Range1d,
    Scatter,
    Segment,
)
from bokeh.palettes import Viridis256
from numpy.typing import NDArray

from sweeps import maps
from sweeps.explore.cells import REASONS, Map, text, ticks

HATCH_CELLS = 128  # of a side; finer hatches are one grey
MOST_SIDES = 20_000  # of a border; more are the noise of cells that differ from all neighbours
INK = "#1a1a1a"
# reason -> (face, ink, pattern), as in the pictures on paper
HATCHES = {
    "not run": ("#ffffff", "#8c8c8c", "dot"),
    "diverged": ("#000000", "#ffffff", "cross"),
    "failed": ("#9e9e9e", "#000000", "horizontal_line"),
    "infinite": ("#ffffff", "#262626", "right_diagonal_line"),
    "not trusted": ("#ffffff", "#1a1a1a", "vertical_line"),
    "no value": ("#d9d9d9", "#333333", "cross_hatch"),
}
# of the selected cell and of pins, in the map and beside the motions
MARKS: tuple[Literal["circle", "triangle", "square", "diamond"], ...] = (
    "circle",
    "triangle",
    "square",
    "diamond",
)
NOTHING = {name: np.zeros(0, np.float32) for name in ("left", "right", "bottom", "top")}
SIDES: dict[str, Any] = {name: name for name in NOTHING}
UNIT: dict[str, Any] = {"x": 0, "y": 0, "dw": 1, "dh": 1}
Picture = dict[str, Any]  # columns of a source
PALETTES = ("nmse", maps.SIGNED_METRICS[0])  # a metric of each kind of colours


def colour_ends(drawn: Map) -> tuple[float, float]:
    """The ends of the colours that suit a map: round numbers."""
    known = drawn.values[drawn.reasons == 0].astype(float)
    low, high, log = maps.limits(drawn.view.metric, known)
    if log:
        return low, high
    size = 10.0 ** math.floor(math.log10(high - low)) / 2
    low, high = math.floor(low / size) * size, math.ceil(high / size) * size
    return float(f"{low:.12g}"), float(f"{high:.12g}")


def logarithmic(metric: str, low: float, high: float) -> bool:
    """Whether colours between two ends are on a log scale."""
    if low <= 0 or metric in maps.LINEAR_METRICS + maps.SIGNED_METRICS:
        return False
    return metric in maps.LOG_METRICS or high > 100 * low


def shades(metric: str) -> NDArray[np.uint32]:
    """256 colours, whose luminance rises, as RGBA in a word."""
    names = Viridis256
    if metric in maps.SIGNED_METRICS:
        stops = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in maps.SIGNED_COLOURS])
        at = np.linspace(0, len(stops) - 1, 256)
        rgb = np.stack([np.interp(at, range(len(stops)), stops[:, i]) for i in range(3)], -1)
        rgb = np.rint(rgb).astype(np.uint8)
    else:
        rgb = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in names], np.uint8)
    rgba = np.concatenate([rgb, np.full((256, 1), 255, np.uint8)], -1)
    return np.ascontiguousarray(rgba).view("<u4")[:, 0]


def image(drawn: Map, low: float, high: float) -> NDArray[np.uint32]:
    """The pixels of a map; those of cells without a number are transparent."""
    values = drawn.values[np.ix_(drawn.y.pixels(), drawn.x.pixels())]
    known = drawn.reasons[np.ix_(drawn.y.pixels(), drawn.x.pixels())] == 0
    with np.errstate(invalid="ignore", divide="ignore"):
        if logarithmic(drawn.view.metric, low, high):
            part = np.log(np.maximum(values, low) / low) / math.log(high / low)
        else:
            part = (values - low) / (high - low)
        shade = np.clip(np.nan_to_num(part * 256), 0, 255).astype(np.uint8)
    return np.where(known, shades(drawn.view.metric)[shade], np.uint32(0))


def boxes(cells: NDArray[np.bool_], x: NDArray[Any], y: NDArray[Any]) -> Picture:
    """Cells as boxes between edges, one for each run along x."""
    rows, columns = (np.arange(0, n, max(1, n // HATCH_CELLS)) for n in cells.shape)
    x, y = np.append(x[columns], x[-1]), np.append(y[rows], y[-1])
    change = np.diff(np.pad(cells[np.ix_(rows, columns)].astype(np.int8), ((0, 0), (1, 1))), axis=1)
    row, start = np.nonzero(change == 1)
    stop = np.nonzero(change == -1)[1]
    sides = {"left": x[start], "right": x[stop], "bottom": y[row], "top": y[row + 1]}
    return {name: side.astype(np.float32) for name, side in sides.items()}


def hatches(drawn: Map) -> Picture:
    """Boxes of the cells without a number, with the look of their reason."""
    parts = []
    for reason, look in HATCHES.items():
        cells = drawn.reasons == REASONS.index(reason)
        if cells.any():
            box = boxes(cells, drawn.x.places, drawn.y.places)
            parts.append(
                box
                | {
                    n: np.full(len(box["left"]), v)
                    for n, v in zip(("face", "ink", "pattern"), look, strict=True)
                }
            )
    if not parts:
        return NOTHING | {name: np.zeros(0, "U1") for name in ("face", "ink", "pattern")}
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return {n: v.tolist() if v.dtype.kind == "U" else v for n, v in joined.items()}


def border(drawn: Map) -> Picture:
    """The sides of cells between those that converge and those that do not."""
    names = ("x0", "y0", "x1", "y1")
    if drawn.converged is None:
        return {name: np.zeros(0, np.float32) for name in names}
    known = (drawn.reasons == 0) | (drawn.reasons == REASONS.index("infinite"))
    sides = maps.sides(drawn.converged, known, drawn.x.places, drawn.y.places)
    sides = sides if len(sides) <= MOST_SIDES else sides[:0]
    return {
        n: np.ascontiguousarray(side, np.float32)
        for n, side in zip(names, sides.reshape(-1, 4).T, strict=True)
    }


def bar(metric: str, low: float, high: float) -> dict[str, Any]:
    """The bar of colours: the index of its colours in PALETTES; places from 0 to 1, and texts."""
    log = logarithmic(metric, low, high)
    span = math.log(high / low) if log else high - low
    found = [
        [(math.log(t / low) if log else t - low) / span, text(t)] for t in ticks(low, high, log)
    ]
    return {"palette": int(metric in maps.SIGNED_METRICS), "ticks": found}


class MapFigure:
    """A figure of a map.

    It has no more models than it needs: the server makes and the browser builds each of them before
    the first map is there.
    """

    def __init__(self) -> None:
        self.image = ColumnDataSource({"image": []}, name="image")
        self.hatches = ColumnDataSource(NOTHING | {"face": [], "ink": [], "pattern": []})
        self.doubt = ColumnDataSource(dict(NOTHING))
        self.border = ColumnDataSource({name: [] for name in ("x0", "y0", "x1", "y1")})
        self.marks = ColumnDataSource({"x": [], "y": [], "mark": []}, name="marks")
        self.figure = Plot(
            name="map",
            aspect_ratio=1.05,
            sizing_mode="stretch_width",
            x_range=Range1d(0, 1),
            y_range=Range1d(0, 1),
            toolbar_location=None,
            min_border=8,
            outline_line_color=INK,
        )
        self.axes = [_axis(), _axis()]
        for axis, side in zip(self.axes, ("below", "left"), strict=True):
            self.figure.add_layout(axis, side)
        drawn = self.figure.add_glyph
        filled = {"fill_color": "face", "hatch_color": "ink", "hatch_pattern": "pattern"}
        drawn(self.hatches, Quad(**SIDES, **filled, line_color=None, hatch_scale=8))
        drawn(self.image, ImageRGBA(image="image", **UNIT))
        for ink, weight in (("white", 3.0), ("black", 1.2)):
            look = {"hatch_color": ink, "hatch_weight": weight, "hatch_scale": 9}
            look |= {"fill_color": None, "line_color": None, "hatch_pattern": "left_diagonal_line"}
            drawn(self.doubt, Quad(**SIDES, **look))
        for ink, width in ((INK, 2.8), ("white", 1.3)):
            look = {"line_color": ink, "line_width": width, "line_cap": "square"}
            drawn(self.border, Segment(x0="x0", y0="y0", x1="x1", y1="y1", **look))
        look = {"fill_color": "white", "line_color": INK, "line_width": 2.5}
        drawn(self.marks, Scatter(x="x", y="y", marker="mark", size=15, **look))

    def show(self, drawn: Map, ends: tuple[float, float]) -> None:
        """Draw a map in colours between two ends."""
        self._put(self.image, {"image": [image(drawn, *ends)]}, always=True)
        self._put(self.hatches, hatches(drawn))
        doubt = drawn.doubt
        self._put(self.doubt, boxes(doubt.untrusted, doubt.x, doubt.y) if doubt else dict(NOTHING))
        self._put(self.border, border(drawn))
        for side, axis in zip(self.axes, (drawn.x, drawn.y), strict=True):
            _tick(side, axis.ticks())

    def mark(self, places: list[tuple[float, float] | None]) -> None:
        """Mark the selected cell and the pins, where they lie on the map."""
        found = [(*place, mark) for place, mark in zip(places, MARKS, strict=False) if place]
        self._put(
            self.marks, {n: [one[i] for one in found] for i, n in enumerate(("x", "y", "mark"))}
        )

    def _put(self, source: ColumnDataSource, data: Picture, always: bool = False) -> None:
        """New data, unless a source is empty and stays so."""
        empty = all(len(column) == 0 for column in data.values())
        if always or not empty or any(len(column) for column in source.data.values()):
            source.data = data


def _axis() -> LinearAxis:
    return LinearAxis(
        ticker=FixedTicker(ticks=[]),
        minor_tick_line_color=None,
        major_label_text_color=INK,
        major_label_text_font_size="13px",
    )


def _tick(axis: Any, places: list[tuple[float, str]]) -> None:
    """Put ticks with texts on an axis, if they are others than before."""
    labels = {place: label for place, label in places}
    if axis.major_label_overrides != labels:
        axis.major_label_overrides = labels
        axis.ticker.ticks = list(labels)  # of a new ticker Bokeh would search the whole page
