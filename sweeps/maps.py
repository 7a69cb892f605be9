"""What a picture of a metric shows, whoever draws it: symbols, scales, colours, borders."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweeps.store.format import ERRORS

SYMBOLS = {  # of the fields, in TeX
    "xd_error": r"$x_d$ − gap",
    "K0": r"$K_0$",
    "Fmax": r"$F_{Max}$",
    "x0": r"$\tilde{x}_0$",
    "xb": r"$\tilde{x}_b$",
    "S": r"$S$",
    "Td": r"$T_d$",
    "xd": r"$x_d$",
    "sigma": r"$\sigma$",
    "period": "control period",  # the paper gives it no symbol
    "I": r"$I$",
    "Kenv": r"$K_{env}$",
    "Denv": r"$D_{env}$",
    "gap": "gap",  # no symbol in the paper either
    "x_init": r"$x(0)$",
    "v_init": r"$\dot{x}(0)$",
}
WORDS = {  # choices of the model; the others are words
    "algorithm1": "Algorithm 1",
    "rk4": "RK4, switches smeared",
    "rk4_events": "RK4, switches located",
}
INFINITE = {  # metric -> what an infinite value says
    "convergence_time": "never converges",
    "contact_time": "never touches",
    "convergence_time_max": "one of them never converges",
    "convergence_time_mean": "one of them never converges",
    "convergence_time_at_best": "never converges with any value",
    "convergence_time_error": "converges in one of two runs",
    "contact_time_error": "touches in one of two runs",
    "nmse_error": "the two runs part",
}
LOG_METRICS = ("nmse", "nmse_tail", *ERRORS)  # the paper compares decades
LINEAR_METRICS = ("convergence_time", "contact_time")
SIGNED_METRICS = ("steady_error",)
MAX_DECADES = 8  # of colours: further below, nmse is rounding in float32
# Where a reader looks for a border: a root mean square error of a tenth of the desired torque.
LEVELS = {"nmse": 0.01, "nmse_tail": 0.01, "contact_lost": 0.0}
UNEVEN = 20  # mean over least step, beyond which each value gets the same width
SEQUENTIAL = "viridis"
# Of a signed metric. Luminance rises from end to end, so that a grey print shows the sign.
# Colour-blind readers can tell blue from orange. Only zero is grey.
SIGNED_COLOURS = ("#0a2463", "#3f6fb5", "#a6a6a6", "#f2b66d", "#fff3d1")


def words(choice: str) -> str:
    """A choice of the model as it is written in a sentence."""
    return WORDS.get(choice, choice.replace("_", " "))


def limits(
    metric: str, values: NDArray[np.float64], spacing: str = ""
) -> tuple[float, float, bool]:
    """The ends of a metric's scale around the middle 98 % of its values, and whether it is log.

    Values of an axis have the spacing of the axis. A log scale ends at powers of ten.
    """
    positive = values[values > 0]
    free = metric not in LINEAR_METRICS + SIGNED_METRICS and 0 < positive.size == values.size
    wide = free and positive.max() > 100 * positive.min()
    log = spacing == "log" if spacing else metric in LOG_METRICS or wide
    if log and positive.size:
        low, high = np.log10(np.quantile(positive, [0.01, 0.99], method="inverted_cdf"))
        top = max(math.ceil(high), math.floor(low) + 1)
        bottom = max(math.floor(low), top - MAX_DECADES)
        return 10.0**bottom, 10.0**top, True
    if not values.size:
        return 0.0, 1.0, False
    low, high = map(float, np.quantile(values, [0.01, 0.99], method="inverted_cdf"))
    if metric in SIGNED_METRICS:
        high = max(abs(low), abs(high))
        low = -high
    if high - low <= 1e-4 * max(abs(low), abs(high)):  # all values are equal, or nearly
        low, high = low - 0.1 * (abs(low) or 1.0), high + 0.1 * (abs(high) or 1.0)
        low = 0.0 if metric in ERRORS else low  # an error is not negative
    return low, high, False


def scale_of(values: NDArray[Any], name: str) -> str:
    """The scale on which the values are most evenly spaced; "category" if they are no grid."""
    parameter = values.dtype.kind == "f" or (values.dtype.kind in "iu" and name in SYMBOLS)
    if not parameter or len(np.unique(values)) < max(2, len(values)):
        return "category"
    ordered = np.sort(values.astype(float))
    positive = ordered[ordered > 0]
    wide = len(positive) > 1 and positive[-1] > 10**1.5 * positive[0]
    if len(positive) < len(ordered):
        # a log axis has no zero, and a linear axis would leave no room for the small decades
        return "category" if wide else _drawable("linear", np.diff(ordered))
    # within a factor of two both scales look alike, and a log axis has no tick
    steps, ratios = np.diff(ordered), np.diff(np.log(ordered))
    uneven = np.std(steps) / np.mean(steps) > np.std(ratios) / np.mean(ratios)
    decided = wide or len(ordered) < 3 or ordered[-1] < 2 * ordered[0]
    log = wide if decided else uneven
    return _drawable("log" if log else "linear", ratios if log else steps)


def _drawable(scale: str, steps: NDArray[np.float64]) -> str:
    """The scale, or "category" if a value would have no width beside its neighbours."""
    return "category" if np.mean(steps) > UNEVEN * np.min(steps) else scale


def edges_of(values: NDArray[Any], scale: str) -> NDArray[np.float64]:
    """Cell edges midway between ascending values on the scale; outer cells are symmetric."""
    if scale == "category" or len(values) == 1:
        return np.arange(len(values) + 1, dtype=np.float64) - 0.5
    numbers = values.astype(np.float64)
    points: NDArray[np.float64] = np.log(numbers) if scale == "log" else numbers
    inner = (points[:-1] + points[1:]) / 2
    first, last = 2 * points[0] - inner[0], 2 * points[-1] - inner[-1]
    edges = np.concatenate([[first], inner, [last]]).astype(np.float64)
    if scale == "log":
        return np.asarray(np.exp(edges), dtype=np.float64)
    if points[0] > 0:
        edges[0] = max(edges[0], 0.0)  # a positive quantity has no negative edge
    return edges


def sides(
    inside: NDArray[np.bool_],
    known: NDArray[np.bool_],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The sides of cells between one inside and a neighbour outside, both known.

    Takes [y, x] cells and their edges; returns [side, end, (x, y)].
    """
    row, column = np.nonzero((inside[:, 1:] != inside[:, :-1]) & known[:, 1:] & known[:, :-1])
    at = x[column + 1]
    upright = np.stack([np.stack([at, y[row]], -1), np.stack([at, y[row + 1]], -1)], 1)
    row, column = np.nonzero((inside[1:] != inside[:-1]) & known[1:] & known[:-1])
    at = y[row + 1]
    level = np.stack([np.stack([x[column], at], -1), np.stack([x[column + 1], at], -1)], 1)
    return np.concatenate([upright, level])
