"""Which readings of the paper fit its claims: a cell for each reading and claim."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from figures import style

DEFAULT = "algorithm1, velocity, latched, interaction"
HOLDS, CONDITION = 2, 1  # verdicts with a mark
MARKS: dict[int, dict[str, Any]] = {
    HOLDS: {"marker": "o", "ms": 2.6, "mew": 0.0, "label": "holds"},
    CONDITION: {"marker": "o", "ms": 2.6, "mew": 0.6, "mfc": "none", "label": "holds where ..."},
}
FONT = 5.5  # point; names of 36 readings beside their rows


def plot(data: xr.Dataset) -> Figure:
    """A block of columns for each period and contact; rows from the best fit at 10 ms down."""
    score, verdict = data["score"], data["verdict"]
    order = np.argsort(-score.isel(setting=0).mean("claim").values, kind="stable")
    score, verdict = score.isel(model=order), verdict.isel(model=order)
    height = 1.2 + 0.11 * score.sizes["model"]
    with rc_context(style.RC):
        fig = Figure(figsize=(style.PAGE_WIDTH, height))
        blocks = fig.subplots(1, score.sizes["setting"], sharey=True, squeeze=False)[0]
        for ax, setting in zip(blocks, score["setting"].values, strict=True):
            mesh = _block(ax, score.sel(setting=setting), verdict.sel(setting=setting))
            ax.set_title(str(setting).replace(", ", "\n"))
        _names(blocks[0], [str(name) for name in score["model"].values])
        bar = fig.colorbar(mesh, ax=list(blocks), pad=0.01, aspect=40)
        bar.set_label("share of scenarios as claimed")
        handles, _ = blocks[0].get_legend_handles_labels()
        fig.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return fig


def _block(ax: Axes, score: xr.DataArray, verdict: xr.DataArray) -> QuadMesh:
    values = score.transpose("model", "claim").values
    mesh = ax.pcolormesh(values, cmap="Blues", norm=Normalize(0, 1), edgecolors="white", lw=0.4)
    for code, mark in MARKS.items():
        rows, columns = np.nonzero(verdict.transpose("model", "claim").values == code)
        ax.plot(columns + 0.5, rows + 0.5, ls="none", color="#D55E00", **mark)
    claims = [str(claim) for claim in score["claim"].values]
    ax.set_xticks(np.arange(len(claims)) + 0.5, claims, rotation=90, fontsize=FONT)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    ax.invert_yaxis()
    return mesh


def _names(ax: Axes, names: list[str]) -> None:
    ax.set_ylim(len(names), 0)
    shown = [f"{name} (default)" if name == DEFAULT else name for name in names]
    ax.set_yticks(np.arange(len(names)) + 0.5, shown, fontsize=FONT)
    for text in ax.get_yticklabels():
        text.set_fontweight("bold" if text.get_text().endswith("(default)") else "normal")
