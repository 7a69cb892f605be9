"""A signal over time: a line, or, where it oscillates too fast for one, the band that it fills."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from figures import style

STRETCH = 4.0  # point; a line that turns twice in it is ink
TURNS = 2  # in a stretch: the median of the WINDOW around it
WINDOW = 9  # stretches; without it a signal near the limit changes its look at each stretch
LEAST = 0.03  # of the signal's range; a smaller rise or fall is hardly thicker than a line
CUT = "triangle: goes on beyond the axis"  # in a legend
LABEL = "band: range of a fast oscillation"  # in a legend
BAND = 0.3  # opacity: a line in front of a band, and one behind it, is seen


def draw(ax: Axes, t: NDArray[Any], y: NDArray[Any], width: float, **look: Any) -> bool:
    """Draw a signal into an axis that is `width` points wide; `look` is that of the line.

    The band is from the least to the largest value in each stretch: no peak is lost.
    Returns whether there is one.
    """
    finite = np.isfinite(y)
    t, y = t[finite], y[finite]
    (line,) = ax.plot(t, y, **look)
    part = stretches(t, width)
    low, high, fast = envelope(y, part)
    if not fast.any():
        return False
    inside = fast[part]
    # the line goes on to the first sample of a band, so that none gapes
    joined = inside & np.append(inside[1:], True) & np.append(True, inside[:-1])
    line.set_ydata(np.where(joined, np.nan, y))
    ends = np.linspace(t[0], t[-1], len(fast) + 1)
    at = np.stack([ends[:-1], ends[1:]], 1).ravel()
    colour = line.get_color()
    ax.fill_between(
        at,
        np.repeat(low, 2),
        np.repeat(high, 2),
        where=np.repeat(fast, 2),
        facecolor=(colour, BAND),
        edgecolor=colour,
        linewidth=0.5,
        linestyle=line.get_linestyle(),
        zorder=line.get_zorder() - 0.1,
    )
    return True


def mark_cut(ax: Axes, curves: Sequence[tuple[NDArray[Any], NDArray[Any], Any]]) -> bool:
    """Mark each curve (t, y, colour) that leaves an axis, and say how far the farthest goes.

    Call it once the limits of the axis are final. Returns whether any curve leaves it.
    """
    any_cut = False
    for end, marker, farthest in (
        (ax.get_ylim()[1], "^", np.nanargmax),
        (ax.get_ylim()[0], "v", np.nanargmin),
    ):
        up = marker == "^"
        peaks = [(t[i := int(farthest(y))], y[i], colour) for t, y, colour in curves]
        cut = [peak for peak in peaks if (peak[1] > end if up else peak[1] < end)]
        for at, _, colour in cut:
            ax.plot(at, end, marker, color=colour, ms=4, mew=0, clip_on=False, zorder=4)
        if cut:
            at, value, _ = max(cut, key=lambda peak: abs(peak[1]))
            inside = "top" if up else "bottom"
            look: dict[str, Any] = {"fontsize": style.SMALL_SIZE, "va": inside}
            text = f"to {style.number(float(value), 2 if abs(value) < 99.5 else 3)}"
            ax.annotate(text, (at, end), (4, 0), textcoords="offset points", **look)
        any_cut |= bool(cut)
    return any_cut


def stretches(t: NDArray[Any], width: float) -> NDArray[np.intp]:
    """The stretch of the picture that each sample lies in."""
    n = max(round(width / STRETCH), 1)
    share = (t - t[0]) / max(t[-1] - t[0], np.finfo(float).tiny)
    return np.minimum((share * n).astype(np.intp), n - 1)


def envelope(
    y: NDArray[Any], part: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Least and largest value of each stretch, and whether the signal oscillates fast in it."""
    n = int(part[-1]) + 1
    low, high, turns = np.full(n, np.inf), np.full(n, -np.inf), np.zeros(n, int)
    np.minimum.at(low, part, y)
    np.maximum.at(high, part, y)
    ends = np.flatnonzero(np.diff(y[1:]) * np.diff(y[:-1]) < 0) + 1  # of rises and falls
    large = np.abs(np.diff(y[ends])) > LEAST * (y.max() - y.min())
    np.add.at(turns, part[ends[1:][large]], 1)
    half = WINDOW // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(turns, half, "symmetric"), WINDOW)
    return (
        low,
        high,
        (np.median(around, -1) >= TURNS) & (high >= low),
    )  # a stretch may have no sample
