"""What Fmax = Td changes over the atlas: decades of the tail error, over three planes."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from figures import colours, style
from figures.findings.maps import CHANGE, DOTS, GROWN, cells, grown, over
from figures.paper.look import label

PLANES = {"Kenv": True, "Denv": True, "Td": False}  # drawn upwards; whether on a log axis
X0 = 0.10  # rad, of the sweep
DECADES = 3.0  # either way; beyond, the colour bar has an arrow
CHANGE_LABEL = "change of nmse, last 5 s\n(decades, median)"


def plot(data: xr.Dataset) -> Figure:
    """Over K0: the median change of nmse_tail in decades, and the share of cells where it grows."""
    with style.look():
        fig = Figure(figsize=(style.PAGE_WIDTH, 4.1))
        grid = fig.subplots(2, len(PLANES), sharex=True)
        kinds: tuple[tuple[str, str, dict[str, Any]], ...] = (
            ("change", CHANGE_LABEL, {"cmap": CHANGE, "norm": Normalize(-DECADES, DECADES)}),
            ("worse", "share of cells\nwhere it grows", {"cmap": "Greys", "norm": Normalize(0, 1)}),
        )
        for row, (name, text, kind) in zip(grid, kinds, strict=True):
            for ax, (side, log) in zip(row, PLANES.items(), strict=True):
                mesh = cells(ax, data[f"{name}_{side}"], "K0", side, (True, log), **kind)
                if name == "change":
                    # in a grey print both signs are dark
                    grown(ax, data[f"{name}_{side}"], "K0", side, (True, log))
                if side == "Td":
                    Td = np.linspace(*ax.get_ylim())
                    over(ax, Td / X0, Td, label=r"$K_0 \tilde{x}_0 = T_d$")
                    ax.set_xlim(row[0].get_xlim())
            drawn = np.concatenate([data[f"{name}_{side}"].values.ravel() for side in PLANES])
            extend = colours.extend(drawn, kind["norm"])
            fig.colorbar(mesh, ax=list(row), extend=extend, pad=0.01, aspect=14).set_label(text)
        for ax in grid[1]:
            ax.set_xlabel(label("K0"))
        if any((data[f"change_{side}"] > GROWN).any() for side in PLANES):
            box = Patch(
                facecolor="white", label=f"dots: grows by more than {GROWN:g} decades", **DOTS
            )
            fig.legend(handles=[box], loc="outside lower center", frameon=False)
        grid[0, -1].legend(loc="upper left", frameon=True, edgecolor="none", facecolor="0.8")
        fig.suptitle(f"{style.SYMBOLS['Fmax']} = {style.SYMBOLS['Td']} against 15 N·m")
    return fig
