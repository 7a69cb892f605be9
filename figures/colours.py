"""The scale of a metric: of its colours, and of an axis that it is drawn on."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from figures import style
from figures.cut import Cells
from figures.style import EDGED
from sweeps.store.format import ERRORS

LOG_METRICS = ("nmse", "nmse_tail", *ERRORS)  # the paper compares decades
LINEAR_METRICS = ("convergence_time", "contact_time")
SIGNED_METRICS = ("steady_error",)
MAX_DECADES = 8  # of colours: further below, nmse is rounding in float32
# Where a reader looks for a border: a root mean square error of a tenth of the desired torque.
LEVELS = {"nmse": 0.01, "nmse_tail": 0.01, "contact_lost": 0.0}


def pool(parts: Sequence[Cells]) -> NDArray[np.float64]:
    """All values of some pictures of one metric."""
    return np.concatenate([np.ravel(part.values.compressed()) for part in parts])


def colour_map(metric: str) -> Colormap:
    """Colours that show the sign, or the size."""
    return style.DIVERGING if metric in SIGNED_METRICS else colormaps[style.SEQUENTIAL]


def norm(metric: str, values: NDArray[np.float64]) -> Normalize:
    """A scale between round numbers around the middle 98 % of the values."""
    positive = values[values > 0]
    free = metric not in LINEAR_METRICS + SIGNED_METRICS and 0 < positive.size == values.size
    log = metric in LOG_METRICS or (free and positive.max() > 100 * positive.min())
    if log and positive.size:
        low, high = np.log10(np.quantile(positive, [0.01, 0.99], method="inverted_cdf"))
        top = max(math.ceil(high), math.floor(low) + 1)
        bottom = max(math.floor(low), top - MAX_DECADES)
        # clip: an exact zero gets the lowest colour; without it the cell would be blank
        return LogNorm(10.0**bottom, 10.0**top, clip=True)
    if not values.size:
        return Normalize(0, 1)
    low, high = np.quantile(values, [0.01, 0.99], method="inverted_cdf")
    if metric in SIGNED_METRICS:
        high = max(abs(low), abs(high))
        low = -high
    if high - low <= 1e-4 * max(abs(low), abs(high)):  # all values are equal, or nearly
        low, high = low - 0.1 * (abs(low) or 1.0), high + 0.1 * (abs(high) or 1.0)
        low = 0.0 if metric in ERRORS else low  # an error is not negative
    ticks = MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    return Normalize(ticks[0], ticks[-1])


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
    scale = norm(part.metric, values)
    bar = fig.colorbar(
        drawn, ax=axes, extend=extend(values, scale), fraction=0.08, pad=0.02, aspect=22
    )
    bar.outline.set_linewidth(0.5)
    bar.set_label(style.fold(part.label, length))
    bar.minorticks_off()
    level = LEVELS.get(part.metric)
    if level and 0 < scale(level) < 1:
        bar.ax.axhline(level, color="white", lw=1.1, path_effects=EDGED)
