"""The best search resolution over the environment's stiffness and damping, and what it gains."""

from typing import Any

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch, PathPatch

from figures import colours, hatch, style
from figures.findings.maps import cells, edges
from figures.paper import look

TORQUE = 5.0  # N*m, the paper's
STIFFNESSES = (30.0, 100.0, 300.0, 1000.0)  # N*m/rad
RULE = (0.01, 0.03, 0.1, 0.3)  # sigma at the lines of the rule of thumb
ROWS = {"best_nmse": style.SEQUENTIAL, "gain_nmse": "cividis"}
# end of the sweep -> hatch of the cells whose best is there; the largest has a light colour
EDGES: dict[str, dict[str, Any]] = {
    "largest": {"hatch": "....", "hatchcolor": "0.2"},
    "smallest": {"hatch": "////", "hatchcolor": "white"},
}
INK: dict[str, Any] = {"hatch_linewidth": 0.6, "linewidth": 0}
LEAST_TOP = 1000.0  # times the best nmse, top of the lower colour bar


def plot(data: xr.Dataset) -> Figure:
    """Above the sigma of the least nmse, below how many times larger nmse is at 0.01."""
    shown = [K0 for K0 in STIFFNESSES if K0 in data["K0"].values]
    here = data.sel(K0=shown, Td=TORQUE)
    with style.look():
        fig = Figure(figsize=(style.PAGE_WIDTH, 4.1))
        grid = fig.subplots(2, len(shown), sharex=True, sharey=True, squeeze=False)
        ends = {end: data.attrs[end] for end in EDGES}
        # every sigma of the sweep has a colour of its own
        scales = LogNorm(ends["smallest"], ends["largest"]), LogNorm(1.0, LEAST_TOP)
        for column, K0 in zip(grid.T, shown, strict=True):
            one = here.sel(K0=K0)
            column[0].set_title(look.values("K0", [K0])[0])
            best, gain = (
                cells(ax, one[name], "Kenv", "Denv", cmap=cmap, norm=norm)
                for ax, (name, cmap), norm in zip(column, ROWS.items(), scales, strict=True)
            )
            for end, sigma in ends.items():
                _mark(column[0], one["best_nmse"] == sigma, EDGES[end])
            _rule(column[0], one)
            column[1].set_xlabel(look.label("Kenv"))
        for ax in grid.flat:
            ax.label_outer()
        names = r"best $\sigma$", r"nmse at $\sigma$ = 0.01" "\nover the best"
        for row, mesh, name, scale, text in zip(
            grid, (best, gain), ROWS, scales, names, strict=True
        ):
            extend = colours.extend(here[name].values.ravel(), scale)
            bar = fig.colorbar(mesh, ax=list(row), extend=extend, pad=0.01, aspect=14)
            bar.set_label(text)
        handles, labels = grid[0, -1].get_legend_handles_labels()
        for end, pattern in EDGES.items():
            if bool((here["best_nmse"] == ends[end]).any()):
                handles.append(Patch(facecolor="0.65", **pattern, **INK))
                labels.append(rf"best is the {end} of the sweep, {ends[end]:g}")
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": 3, "frameon": False}
        fig.legend(handles, labels, **place)
    return fig


def _mark(ax: Axes, inside: xr.DataArray, pattern: dict[str, Any]) -> None:
    """A hatch over cells of a map: beyond the sweep's edge sigma may be better still."""
    sides = [edges(inside[name].values.astype(float)) for name in ("Kenv", "Denv")]
    path = hatch.outline(inside.transpose("Denv", "Kenv").values, *sides)
    ax.add_artist(PathPatch(path, facecolor="none", **pattern, **INK))


def _rule(ax: Axes, data: xr.Dataset) -> None:
    """Lines of the rule of thumb, with their sigma."""
    if not data["rule"].notnull().any():
        return
    rule = data["rule"].transpose("Denv", "Kenv").values
    lines = ax.contour(
        data["Kenv"], data["Denv"], rule, RULE, colors="white", linewidths=0.9, linestyles="--"
    )
    ax.clabel(lines, fmt=lambda level: f"{level:g}", fontsize=style.SMALL_SIZE)
    ax.plot([], [], color="0.4", lw=0.9, ls="--", label=r"white: $\sigma$ of the rule of thumb")
