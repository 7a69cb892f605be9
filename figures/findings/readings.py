"""Which readings of the paper fit its claims: a cell for each reading and claim."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from figures import style

DEFAULT = "algorithm1, velocity, latched, interaction; 10 ms"
BOTH = "not welded"  # in the name of a reading with two solvers
HOLDS, CONDITION = 2, 1  # verdicts with a mark
MARKS: dict[int, dict[str, Any]] = {
    HOLDS: {"marker": "o", "ms": 2.6, "mew": 0.0, "label": "holds"},
    CONDITION: {"marker": "o", "ms": 2.6, "mew": 0.6, "mfc": "none", "label": "holds where ..."},
}
FONT = 5.5  # point; long names of readings beside their rows
ROW = 0.13  # inches


def plot(data: xr.Dataset) -> Figure:
    """The best reading of each way to run the studies and each meaning of x~, and the default."""
    shown = best_of_each(data)
    with style.look():
        height = 1.1 + ROW * shown.sizes["reading"]
        fig = Figure(figsize=(style.PAGE_WIDTH, height))
        ax = fig.subplots()
        mesh = cells(ax, shown)
        bar = fig.colorbar(mesh, ax=ax, pad=0.02, aspect=40)
        bar.set_label("share of scenarios as claimed")
        handles, _ = ax.get_legend_handles_labels()
        fig.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return fig


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


def cells(ax: Axes, data: xr.Dataset) -> QuadMesh:
    """Shares as colours and verdicts as marks, a row for each reading."""
    values = data["score"].transpose("reading", "claim").values
    mesh = ax.pcolormesh(values, cmap="Blues", norm=Normalize(0, 1), edgecolors="white", lw=0.4)
    for code, mark in MARKS.items():
        rows, columns = np.nonzero(data["verdict"].transpose("reading", "claim").values == code)
        ax.plot(columns + 0.5, rows + 0.5, ls="none", color="#D55E00", **mark)
    claims = [str(claim) for claim in data["claim"].values]
    ax.set_xticks(np.arange(len(claims)) + 0.5, claims, rotation=90, fontsize=FONT)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    names = [str(name) for name in data["reading"].values]
    shown = [f"{name} (default)" if name == DEFAULT else name for name in names]
    ax.set_ylim(len(names), 0)
    ax.set_yticks(np.arange(len(names)) + 0.5, shown, fontsize=FONT)
    for text in ax.get_yticklabels():
        text.set_fontweight("bold" if text.get_text().endswith("(default)") else "normal")
    return mesh
