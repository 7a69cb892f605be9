"""The motions of the selected cell and the pins as six Bokeh figures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import (
    BasicTicker,
    ColumnDataSource,
    DataRange1d,
    FixedTicker,
    Grid,
    LinearAxis,
    MultiLine,
    Plot,
    Span,
)

from sweeps.explore.motion import Motion
from sweeps.explore.picture import INK

# Each has a contrast of 4.5 or more on white, and its own dashes: selected cell, then pins.
LOOKS = {
    "colour": ("#000000", "#b3460e", "#0066a6", "#8a1f7a"),
    "dash": ("solid", "dashed", "dotdash", "dotted"),
    "width": (1.6, 1.6, 1.6, 2.2),
}
# name of a figure -> its columns
FIGURES = {
    "torque": ("t", "T"),
    "error": ("t", "e"),
    "position": ("t", "x"),
    "branch": ("steps", "branch"),
    "energy": ("t", "V"),
    "phase": ("x", "v"),
}
COLUMNS = ("t", "T", "e", "x", "V", "v", "steps", "branch")
# A motion that has left this multiple of the largest torque is drawn no further.
DIVERGED = 1e3


def columns(motion: Motion) -> dict[str, Any]:
    """The signals of a motion as arrays, up to where it diverges."""
    s, p = motion.samples, motion.scenario.params
    T = np.asarray(s.tau_env)
    beyond = np.flatnonzero(~(np.abs(T) <= DIVERGED * max(abs(float(p.Td)), float(p.Fmax))))
    kept = max(int(beyond[0]), 1) if beyond.size else T.size
    found = {"t": s.t, "T": T, "e": s.e, "x": s.x, "V": motion.V, "v": s.v}
    found = {name: np.asarray(values)[:kept] for name, values in found.items()}
    # a branch is that of the step that ends at t
    found["steps"] = np.repeat(np.append(0.0, found["t"]), 2)[1:-1]
    found["branch"] = np.repeat(np.asarray(s.diverging)[:kept], 2)
    return {name: np.ascontiguousarray(found[name], np.float32) for name in COLUMNS}


class MotionFigures:
    """Six figures: torque, error, position, branch and V over time, and the phase portrait."""

    def __init__(self) -> None:
        empty: dict[str, Any] = {name: [] for name in (*COLUMNS, *LOOKS)}
        self.source = ColumnDataSource(empty, name="motions")
        self.figures = {name: self._figure(name, *xy) for name, xy in FIGURES.items()}
        line: dict[str, Any] = {"dimension": "width", "line_color": "#707070", "line_width": 1}
        self.Td, self.gap = Span(location=0, **line), Span(location=0, **line)
        self.figures["torque"].add_layout(self.Td)
        self.figures["position"].add_layout(self.gap)

    def _figure(self, name: str, x: str, y: str) -> Plot:
        plot = Plot(
            name=name,
            visible=False,  # until there is a motion
            height=170,
            sizing_mode="stretch_width",
            min_border=8,
            toolbar_location=None,
            outline_line_color=INK,
            x_range=DataRange1d(),
            y_range=DataRange1d(),
        )
        for side, dimension in (("below", 0), ("left", 1)):
            axis = LinearAxis(
                ticker=BasicTicker(desired_num_ticks=5),
                minor_tick_line_color=None,
                major_label_text_color=INK,
                major_label_text_font_size="12px",
            )
            if (name, side) == ("branch", "left"):
                axis.ticker = FixedTicker(ticks=[0, 1])
                axis.major_label_overrides = {0: "converging", 1: "diverging"}
            plot.add_layout(axis, side)
            grid = Grid(dimension=dimension, ticker=axis.ticker, grid_line_color="#e3e3e3")
            plot.add_layout(grid)
        look: dict[str, Any] = {"line_color": "colour", "line_dash": "dash", "line_width": "width"}
        plot.add_glyph(self.source, MultiLine(xs=x, ys=y, **look))
        return plot

    def show(self, motions: Sequence[Motion | None]) -> None:
        """Draw the selected cell's motion and those of the pins."""
        drawn = [(i, columns(motion)) for i, motion in enumerate(motions) if motion]
        data: dict[str, Any] = {name: [one[name] for _, one in drawn] for name in COLUMNS}
        data |= {name: [looks[i] for i, _ in drawn] for name, looks in LOOKS.items()}
        self.source.data = data
        for plot in self.figures.values():
            plot.visible = bool(drawn)
        if motions and (first := motions[0]):
            self.Td.location = float(first.scenario.params.Td)
            self.gap.location = float(first.scenario.params.gap)
