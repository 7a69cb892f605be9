"""What explains the paper: the share of each claim as printed, under the best reading, at best."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import style
from figures.findings.readings import DEFAULT, best_of_each

KINDS = (("as printed, 10 ms", "o", "0.4"), ("best reading", "s", "#0072B2"))


def plot(data: xr.Dataset) -> Figure:
    """A place for each claim: two readings as marks, the most under any as a line above them."""
    best = str(best_of_each(data)["reading"].values[0])
    ids = [str(id) for id in data["claim"].values]
    at = np.arange(len(ids))
    with style.look():
        fig = Figure(figsize=(style.COLUMN_WIDTH, 2.6))
        ax = fig.subplots()
        most = 100 * data["score"].max("reading").values
        ax.plot(at, most, ls="", marker="_", ms=12, color="#D55E00", label="most under any reading")
        # side by side, so that none hides another
        for (text, marker, colour), reading, shift in zip(
            KINDS, (DEFAULT, best), (-0.18, 0.18), strict=True
        ):
            share = 100 * data["score"].sel(reading=reading).values
            ax.plot(at + shift, share, ls="", marker=marker, ms=3.5, color=colour, label=text)
        ax.set_xticks(at, ids, rotation=90)
        ax.set(ylim=(-4, 104), ylabel="scenarios as claimed (%)", xlabel="claim of the paper")
        fig.legend(loc="outside upper center", ncols=3, frameon=False)
    return fig
