"""The best search resolution over the environment's stiffness and damping, and what it gains."""

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from figures import style
from figures.findings.maps import cells
from figures.paper.look import label

TORQUE = 5.0  # N*m, the paper's
STIFFNESSES = (30.0, 100.0, 300.0, 1000.0)  # N*m/rad
RULE = (0.01, 0.03, 0.1, 0.3)  # sigma at the lines of the rule of thumb
LEAST_TOP = 1000.0  # times the best nmse, top of the lower colour bar


def plot(data: xr.Dataset) -> Figure:
    """Above the sigma of the least nmse, below how many times larger nmse is at 0.01."""
    shown = [K0 for K0 in STIFFNESSES if K0 in data["K0"].values]
    with style.look():
        fig = Figure(figsize=(style.PAGE_WIDTH, 3.9))
        grid = fig.subplots(2, len(shown), sharex=True, sharey=True, squeeze=False)
        for column, K0 in zip(grid.T, shown, strict=True):
            here = data.sel(K0=K0, Td=TORQUE)
            column[0].set_title(f"$K_0$ = {style.number(K0)} N·m/rad")
            best = cells(
                column[0],
                here["best_nmse"],
                "Kenv",
                "Denv",
                cmap=style.SEQUENTIAL,
                norm=LogNorm(1e-3, 1.0),
            )
            _rule(column[0], here)
            norm = LogNorm(1.0, LEAST_TOP)
            gain = cells(column[1], here["gain_nmse"], "Kenv", "Denv", cmap="cividis", norm=norm)
            column[1].set_xlabel(label("Kenv"))
        for ax in grid.flat:
            ax.label_outer()
        for row, mesh, text in (
            (grid[0], best, r"best $\sigma$"),
            (grid[1], gain, r"nmse at $\sigma$ = 0.01" "\nover the best"),
        ):
            extend = "both" if row is grid[0] else "max"
            bar = fig.colorbar(mesh, ax=list(row), extend=extend, pad=0.01, aspect=14)
            bar.set_label(text)
        handles = grid[0, -1].get_legend_handles_labels()
        fig.legend(*handles, loc="outside lower center", frameon=False)
    return fig


def _rule(ax: Axes, data: xr.Dataset) -> None:
    """Lines of the rule of thumb, with their sigma."""
    if not data["rule"].notnull().any():
        return
    rule = data["rule"].transpose("Denv", "Kenv").values
    lines = ax.contour(
        data["Kenv"], data["Denv"], rule, RULE, colors="white", linewidths=0.9, linestyles="--"
    )
    ax.clabel(lines, fmt=lambda level: f"{level:g}", fontsize=5.5)
    ax.plot([], [], color="0.4", lw=0.9, ls="--", label=r"white: $\sigma$ of the rule of thumb")
