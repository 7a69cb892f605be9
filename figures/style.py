"""The look of every figure: sizes, symbols, colours, hatches and numbers; and `save`."""

import math
import os
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import colormaps, rc_context, rcdefaults, rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.textpath import TextPath

from sweeps import maps

COLUMN_WIDTH = 3.5  # inch, one column of a two-column paper
PAGE_WIDTH = 7.16  # inch, both columns
FONT_SIZE = 7.5  # point; smaller letters are hard to read in a printed column
SMALL_SIZE = 7.0  # point; legend and numbers inside cells

RC: dict[Any, Any] = {  # Any: matplotlib types its keys as 300 literals
    "figure.dpi": 300,
    "savefig.dpi": 300,
    "figure.constrained_layout.use": True,
    "font.size": FONT_SIZE,
    "axes.titlesize": FONT_SIZE,
    "axes.labelsize": FONT_SIZE,
    "figure.titlesize": FONT_SIZE,
    "xtick.labelsize": FONT_SIZE - 0.5,
    "ytick.labelsize": FONT_SIZE - 0.5,
    "legend.fontsize": SMALL_SIZE,
    "legend.title_fontsize": SMALL_SIZE,
    "axes.linewidth": 0.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 1.5,
    "ytick.minor.size": 1.5,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "hatch.linewidth": 0.5,
    "mathtext.fontset": "dejavusans",
    "svg.hashsalt": "fic_jax",
}


@contextmanager
def look() -> Iterator[None]:
    """Draw with matplotlib's defaults and RC, whatever the user's matplotlibrc or style says.

    Text, axes and legends read most settings when they are made, and the rest when they are drawn.
    """
    with rc_context():
        rcdefaults()
        rcParams.update(RC)
        yield


# as in the browser
SYMBOLS, SEQUENTIAL, words = maps.SYMBOLS, maps.SEQUENTIAL, maps.words
# Of choices (Okabe and Ito): any two differ for colour-blind readers, the first three in grey too.
CHOICES = ["#0072B2", "#F0E442", "#D55E00", "#56B4E9", "#009E73", "#CC79A7"]
# Of lines on white: blue to orange. Its lighter end has a contrast below 3 and fades in print.
ORDERED, LIGHTEST = "plasma", 0.63
DIVERGING = LinearSegmentedColormap.from_list("signed", maps.SIGNED_COLOURS)


DASHES: tuple[Any, ...] = (
    "-",
    "--",
    "-.",
    (0, (1, 1)),
    (0, (4, 1, 1, 1, 1, 1)),
    (0, (7, 2)),
)


def ordered(n: int) -> list[tuple[float, float, float, float]]:
    """Colours of n ordered values, dark to light, each with a contrast of 3 or more on white."""
    shades = colormaps[ORDERED]
    return [shades(LIGHTEST * i / max(n - 1, 1)) for i in range(n)]


@dataclass(frozen=True)
class Hatch:
    """The look of cells without a number: no colour of the map has a hatch."""

    face: str
    ink: str
    pattern: str


HATCHES = {
    "not run": Hatch("white", "0.55", "....."),
    "diverged": Hatch("black", "white", "xxxxx"),
    "failed": Hatch("0.62", "black", "-----"),
    "infinite": Hatch("white", "0.15", "//////"),
    "not trusted": Hatch("white", "0.1", "|||||"),
    "no value": Hatch("0.85", "0.2", "+++++"),
}


# Dark edges make a line over a map seen on every colour.
EDGED: list[AbstractPathEffect] = [withStroke(linewidth=2.4, foreground="0.15")]

# The markers of points without a value: no value of the metric has one of them.
MARKS = {
    "not run": ".",
    "diverged": "x",
    "failed": "+",
    "infinite": "^",
    "no value": "1",
    "not trusted": "2",
}

UNTRUSTED = 4 * "\\"  # the hatch over the colour of a cell that is not trusted


def units_text(units: str) -> str:
    """A unit for print: N·m for N*m, nothing for 1."""
    return "" if units in ("", "1") else units.replace("*", "·").replace("^2", "²")


def number(value: float, digits: int = 4) -> str:
    """A number with some significant digits; a power of ten if plain digits would be long."""
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text.replace("-", "−")
    mantissa, exponent = text.split("e")
    power = f"10^{{{int(exponent)}}}"
    return f"${power}$" if mantissa == "1" else rf"${mantissa}\times {power}$"


def cell_number(value: float, digits: int) -> str:
    """A number with `digits` significant digits, as short as possible: 0.012, 3.1, 240, 1.5e-5."""
    if value == 0:
        return "0"
    text = f"{value:.{digits - 1}e}"
    mantissa, exponent = text.split("e")
    power = int(exponent)
    if -3 <= power < 4:
        return f"{float(text):.{max(digits - 1 - power, 0)}f}".replace("-", "−")
    return ("−" if value < 0 else "") + f"{mantissa.lstrip('-')}e{power}"


def share(fraction: float) -> str:
    """A fraction in percent; only exactly 0 and 1 become 0 and 100."""
    percent = 100 * fraction
    if 0 < percent < 0.1:
        return "<0.1"
    if 99.5 <= percent < 100:
        return ">99"
    return f"{percent:.0f}" if percent >= 9.95 or percent == 0 else f"{percent:.1f}"


def text_width(text: str, size: float) -> float:
    """Width of the longest line in points."""
    font = FontProperties(family="DejaVu Sans", size=size)
    lines = [line for line in text.split("\n") if line.strip()]
    return max((TextPath((0, 0), line, prop=font).get_extents().width for line in lines), default=0)


def wrap(pieces: list[str], width: float, size: float = FONT_SIZE) -> str:
    """Join pieces by commas into lines of at most `width` points; break no piece."""
    lines: list[str] = []
    for piece in pieces:
        if lines and text_width(f"{lines[-1]}, {piece}", size) <= width:
            lines[-1] += f", {piece}"
        else:
            lines.append(piece)
    return ",\n".join(lines)


def fold(text: str, width: float, size: float = FONT_SIZE) -> str:
    """Break text at spaces and hyphens into lines of at most `width` points."""
    wide = text_width(text, size)
    if wide <= width:
        return text
    return textwrap.fill(text, max(8, math.floor(0.9 * len(text) * width / wide)))


UNDATED: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    ".svg": {"Date": None, "Creator": None},
}


def save(fig: Figure, path: str | os.PathLike[str]) -> None:
    """Write a PNG (200 dpi), PDF or SVG; the same figure gives the same bytes at any time.

    The file has its name once it is whole. Raises ValueError for another suffix.
    """
    path = Path(os.path.realpath(path))  # a link stays a link
    suffix = path.suffix.lower()
    if suffix not in UNDATED:
        raise ValueError(f"a picture ends in {', '.join(UNDATED)}, not in '{suffix}'")
    partial = path.with_name(f".{path.name}.partial")
    try:
        with look():
            FigureCanvasAgg(fig).print_figure(
                partial, format=suffix[1:], dpi=200, bbox_inches="tight", metadata=UNDATED[suffix]
            )
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
