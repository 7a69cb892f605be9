"""The swing of a joint whose stiffness changes in step with its motion."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import style
from figures.paper import look


def plot(data: xr.Dataset) -> Figure:
    """|x| over time for each ratio of the stiffnesses, and the derived growth while linear."""
    with style.look():
        fig = Figure(figsize=(style.COLUMN_WIDTH, 3.3))
        ax = fig.subplots()
        t, x0 = data["t"].values, data.attrs["x0"]
        shades = style.ordered(data.sizes["ratio"])
        for i, (colour, dashes) in enumerate(zip(shades, style.DASHES, strict=False)):
            run = data.isel(ratio=i)
            factor, length = float(run["predicted"]), float(run["round"])
            text = f"ratio {float(run['ratio']):g}: peak × {factor:.2f} each round"
            ax.plot(
                t,
                _rounds(run["swing"].values, t, length),
                color=colour,
                ls=dashes,
                lw=1.0,
                label=text,
            )
            derived = float(run["swing"][0]) * factor ** (t / length)
            linear = derived <= x0
            ax.plot(t[linear], derived[linear], color=colour, lw=0.4)
        ax.plot([], [], color="0.3", lw=0.4, label="thin: as derived, while the spring is linear")
        ax.axhline(x0, color=look.REFERENCE, lw=0.5)
        ax.text(t[-1], x0, style.SYMBOLS["x0"], ha="right", va="bottom")
        ax.set_yscale("log")
        ax.set(
            xlim=(0, t[-1]),
            ylim=(_decade_below(data), 0.3),
            xlabel="time (s)",
            ylabel="swing (rad)",
        )
        title = "high to low stiffness, changed twice in each swing"
        fig.legend(loc="outside lower center", frameon=False, title=title)
    return fig


def _decade_below(data: xr.Dataset) -> float:
    """A power of ten below every swing drawn."""
    least = min(
        float(_rounds(run.values, data["t"].values, float(length)).min())
        for run, length in zip(data["swing"], data["round"], strict=True)
    )
    return float(10.0 ** np.floor(np.log10(least)))


def _rounds(swing: np.ndarray, t: np.ndarray, length: float) -> np.ndarray:
    """The largest swing within a round about each time: the peaks, without the way between them."""
    width = max(round(length / (t[1] - t[0])), 1)
    padded = np.pad(swing, (width // 2, width - width // 2 - 1), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, width).max(axis=1)
