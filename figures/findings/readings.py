"""Which readings of the paper fit its claims: a cell for each reading and claim."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from figures import style

DEFAULT = "algorithm1, velocity, latched, interaction; 10 ms"
BOTH = "not welded"  # in the name of a reading with two solvers
SHOWN = 12  # readings; the report's table has more
SIGNS = ("", "(+)", "+")  # of the verdicts, as in the report's table
FONT = 6.3  # point; in a column of 3.4 inches it prints as 6
NAMES = 122  # point, width of the names of readings
LINE = 0.11  # inches
DARK = 0.6  # share beyond which a cell is dark


def plot(data: xr.Dataset) -> Figure:
    """The best readings among those of each way to run the studies, and the default."""
    shown = _shown(best_of_each(data))
    with style.look():
        names = [_short(str(name)) for name in shown["reading"].values]
        lines = [name.count("\n") + 1 for name in names]
        fig = Figure(figsize=(style.COLUMN_WIDTH, 1.1 + LINE * sum(lines) + 0.05 * len(lines)))
        ax = fig.subplots()
        heights = np.array(lines) + 0.4
        mesh = cells(ax, shown, names, np.concatenate([[0.0], np.cumsum(heights)]))
        bar = fig.colorbar(mesh, ax=ax, location="top", pad=0.01, aspect=30, shrink=0.9)
        bar.set_label("share of scenarios as claimed")
        fig.supxlabel("claim of the paper: + holds, (+) holds under a condition", fontsize=FONT)
    return fig


def _shown(data: xr.Dataset) -> xr.Dataset:
    """The first readings, and the default."""
    first = np.arange(data.sizes["reading"]) < SHOWN
    return data.isel(reading=np.flatnonzero(first | (data["reading"].values == DEFAULT)))


def _short(name: str) -> str:
    """Name a reading in short lines: its law, its other choices, the time of the search."""
    choices, setting = name.split("; ", 1)
    usual = DEFAULT.split("; ", maxsplit=1)[0].split(", ")
    law, *rest = choices.split(", ")
    different = [choice for choice in rest if choice not in usual]
    text = ", ".join([style.words(law), *different]).replace("x~", r"$\tilde{x}$")
    whole = f"{text}; {setting.replace('e-0', 'e-')}" + (" (default)" if name == DEFAULT else "")
    return style.fold(whole, NAMES, FONT)


def best_of_each(data: xr.Dataset) -> xr.Dataset:
    """The readings drawn, the best fit first; a part of a claim counts for no fit."""
    data = data.sel(claim=[id for id in data["claim"].values if " " not in str(id)])
    order = np.argsort(-data["score"].mean("claim").values, kind="stable")
    seen: set[tuple[str, str]] = set()
    kept = []
    for i in order:
        setting = str(data["setting"].values[i])
        if BOTH in setting:
            setting = BOTH  # the best of all pairs of solvers
        kind = setting, str(data["expectation"].values[i])
        if kind not in seen or data["reading"].values[i] == DEFAULT:
            kept.append(i)
        seen.add(kind)
    return data.isel(reading=kept)


def cells(ax: Axes, data: xr.Dataset, names: list[str], edges: NDArray[np.float64]) -> QuadMesh:
    """Shares as colours and verdicts as signs, a row for each reading between two edges."""
    values = data["score"].transpose("reading", "claim").values
    verdicts = data["verdict"].transpose("reading", "claim").values
    claims = [str(claim) for claim in data["claim"].values]
    middles = (edges[:-1] + edges[1:]) / 2
    look: dict[str, Any] = {"cmap": "Blues", "norm": Normalize(0, 1), "edgecolors": "white"}
    mesh = ax.pcolormesh(np.arange(len(claims) + 1), edges, values, lw=0.4, **look)
    for (row, column), share in np.ndenumerate(values):
        ink = "white" if share > DARK else "black"
        place: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": FONT}
        sign = SIGNS[int(verdicts[row, column])]
        ax.text(column + 0.5, float(middles[row]), sign, color=ink, **place)
    ax.set_xticks(np.arange(len(claims)) + 0.5, claims, rotation=90, fontsize=FONT)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    ax.set_ylim(edges[-1], 0)
    ax.set_yticks(middles, names, fontsize=FONT)
    for text in ax.get_yticklabels():
        text.set_fontweight("bold" if text.get_text().endswith("(default)") else "normal")
    return mesh
