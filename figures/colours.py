"""The scale of a metric: of its colours, and of an axis that it is drawn on."""

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from figures import style
from figures.cut import Cells
from figures.style import EDGED
from sweeps import maps
from sweeps.store.format import LEVEL

COUNTS = (LEVEL, "mode_switches")  # metrics that are whole numbers


def pool(parts: Sequence[Cells]) -> NDArray[np.float64]:
    """All values of some pictures of one metric."""
    return np.concatenate([np.ravel(part.values.compressed()) for part in parts])


def colour_map(part: Cells) -> Colormap:
    """Colours that show the sign, or the size; of choices, one for each."""
    if part.choices:
        return ListedColormap(style.CHOICES[: len(part.choices)])
    signed = part.metric in maps.SIGNED_METRICS
    return style.DIVERGING if signed else colormaps[style.SEQUENTIAL]


def norm(part: Cells, values: NDArray[np.float64]) -> Normalize:
    """A scale between round numbers around the middle 98 % of the values.

    Values of an axis have the spacing of the axis.
    """
    if part.choices:
        return Normalize(0.5, len(part.choices) + 0.5)
    if part.metric == LEVEL:
        return Normalize(0, max(values.max(initial=0), 1))
    low, high, log = maps.limits(part.metric, values, part.spacing)
    if log:
        # clip: an exact zero gets the lowest colour; without it the cell would be blank
        return LogNorm(low, high, clip=True)
    if not values.size:
        return Normalize(low, high)
    ticks = MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    return Normalize(ticks[0], ticks[-1])


def whole_ticks(drawn: Axis, part: Cells, scale: Normalize) -> None:
    """Put the ticks of a metric that counts at whole numbers; a log scale has no others."""
    if part.metric in COUNTS and not isinstance(scale, LogNorm):
        drawn.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True))


def choice_entries(part: Cells) -> dict[str, Patch]:
    """Text -> box, for each choice."""
    return {
        choice: Patch(facecolor=colour, linewidth=0.5, edgecolor="black")
        for choice, colour in zip(part.choices, style.CHOICES, strict=False)
    }


def extend(values: NDArray[np.float64], scale: Normalize) -> str:
    """The ends of a colour bar that get an arrow: those that values exceed."""
    low, high = np.array([scale.vmin, scale.vmax], float)
    below, above = bool((values < low).any()), bool((values > high).any())
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]


def bar(
    fig: Figure,
    drawn: ScalarMappable,
    axes: list[Axes],
    part: Cells,
    values: NDArray[np.float64],
    length: float = 150,
) -> None:
    """One colour bar for axes, `length` points long, with the level that their lines follow."""
    scale = norm(part, values)
    bar = fig.colorbar(
        drawn, ax=axes, extend=extend(values, scale), fraction=0.08, pad=0.02, aspect=22
    )
    bar.outline.set_linewidth(0.5)
    bar.set_label(style.fold(part.label, length))
    bar.minorticks_off()
    whole_ticks(bar.ax.yaxis, part, scale)
    level = maps.LEVELS.get(part.metric)
    if level and 0 < scale(level) < 1:
        bar.ax.axhline(level, color="white", lw=1.1, path_effects=EDGED)
