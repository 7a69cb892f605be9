"""The motions of the selected cell and the pins as six Bokeh figures."""

from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, Line, Span, Step
from bokeh.plotting import figure

from sweeps.explore.motion import Motion
from sweeps.explore.picture import INK
from sweeps.explore.view import MOST_PINS

# each has a contrast of 4.5 or more on white, and its own dashes
LOOKS: tuple[dict[str, Any], ...] = (
    {"line_color": "#000000", "line_dash": "solid", "line_width": 1.6},
    {"line_color": "#b3460e", "line_dash": "dashed", "line_width": 1.6},
    {"line_color": "#0066a6", "line_dash": "dotdash", "line_width": 1.6},
    {"line_color": "#8a1f7a", "line_dash": "dotted", "line_width": 2.2},
)
COLUMNS = ("t", "T", "e", "x", "branch", "V", "v")
# name of a figure -> its columns
FIGURES = {
    "torque": ("t", "T"),
    "error": ("t", "e"),
    "position": ("t", "x"),
    "branch": ("t", "branch"),
    "energy": ("t", "V"),
    "phase": ("x", "v"),
}
# A motion that has left this multiple of the largest torque is drawn no further.
DIVERGED = 1e3


def columns(motion: Motion) -> dict[str, Any]:
    """The signals of a motion as columns of a source, up to where it diverges."""
    s, p = motion.samples, motion.scenario.params
    found = {
        "t": s.t,
        "T": s.tau_env,
        "e": s.e,
        "x": s.x,
        "branch": s.diverging,
        "V": motion.V,
        "v": s.v,
    }
    largest = max(abs(float(p.Td)), float(p.Fmax))
    beyond = np.flatnonzero(~(np.abs(np.asarray(s.tau_env)) <= DIVERGED * largest))
    kept = max(int(beyond[0]), 1) if beyond.size else len(np.asarray(s.t))
    return {name: np.asarray(found[name], np.float32)[:kept] for name in COLUMNS}


class MotionFigures:
    """Six figures: torque, error, position, branch and V over time, and the phase portrait."""

    def __init__(self) -> None:
        empty: dict[str, Any] = {name: [] for name in COLUMNS}
        self.sources = [
            ColumnDataSource(dict(empty), name=f"motion{i}") for i in range(1 + MOST_PINS)
        ]
        self.figures = {name: self._figure(name, *xy) for name, xy in FIGURES.items()}
        self.Td = Span(location=0, dimension="width", line_color="#707070", line_width=1)
        self.gap = Span(location=0, dimension="width", line_color="#707070", line_width=1)
        self.figures["torque"].add_layout(self.Td)
        self.figures["position"].add_layout(self.gap)
        branch = self.figures["branch"].yaxis[0]
        branch.ticker = FixedTicker(ticks=[0, 1])
        branch.major_label_overrides = {0: "converging", 1: "diverging"}

    def _figure(self, name: str, x: str, y: str) -> figure:
        look: dict[str, Any] = {"tools": "", "toolbar_location": None, "min_border": 8}
        f = figure(name=name, visible=False, height=170, sizing_mode="stretch_width", **look)
        for source, line in zip(self.sources, LOOKS, strict=True):
            if name == "branch":
                f.add_glyph(source, Step(x=x, y=y, mode="before", **line))
            else:
                f.add_glyph(source, Line(x=x, y=y, **line))
        f.outline_line_color = INK
        for axis in (*f.xaxis, *f.yaxis):
            axis.minor_tick_line_color = None
            axis.major_label_text_color = INK
            axis.major_label_text_font_size = "12px"
        f.grid.grid_line_color = "#e3e3e3"
        return f

    def show(self, motions: list[Motion | None]) -> None:
        """Draw the selected cell's motion and those of the pins."""
        padded = [*motions, *[None] * (1 + MOST_PINS - len(motions))]
        for source, motion in zip(self.sources, padded, strict=True):
            data: dict[str, Any] = columns(motion) if motion else {n: [] for n in COLUMNS}
            if motion or len(source.data["t"]):
                source.data = data
        for f in self.figures.values():
            f.visible = any(motions)
        if motions and (first := motions[0]):
            self.Td.location = float(first.scenario.params.Td)
            self.gap.location = float(first.scenario.params.gap)
