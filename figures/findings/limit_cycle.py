"""Where the loop limit-cycles, measured, with the boundaries of the formulas; and the stripe."""

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from figures import style
from figures.findings.maps import cells, rows
from figures.paper.look import label

READINGS = ("algorithm1, welded", "algorithm1, hard stop")
SETTLED, CYCLE = "#eef1f4", "#6c8ebf"
NAMES = {"algorithm1": "Algorithm 1", "effort": "one slope\n(effort law)"}
LAWS = {"algorithm1": ("#0072B2", "-"), "effort": ("#D55E00", "--")}


def plot(data: xr.Dataset) -> Figure:
    """A row of maps for each contact, then nmse_tail along K0 through the stripe."""
    readings = [name for name in READINGS if name in data["reading"].values]
    with style.look():
        fig = Figure(figsize=(style.PAGE_WIDTH, 1.5 + 1.75 * len(readings)))
        maps, below = rows(fig, (1.55 * len(readings), 1.0))
        grid = maps.subplots(len(readings), data.sizes["map"], squeeze=False, sharex=True)
        for ax in grid[-1]:
            ax.set_xlabel(label("K0"))
        for line, reading in zip(grid, readings, strict=True):
            for ax, name in zip(line, data["map"].values, strict=True):
                _map(ax, data.sel(reading=reading, map=name))
            line[0].set_title(reading.split(", ")[1], loc="left", fontweight="bold")
        for ax, Denv in zip(grid[0], data["Denv"].values, strict=True):
            ax.set_title(f"$D_{{env}}$ = {style.number(Denv)} N·m·s/rad", loc="right")
        handles, _ = grid[0, 0].get_legend_handles_labels()
        handles = [Patch(color=CYCLE, label="limit cycle, measured"), *handles]
        maps.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
        _stripe(below.subplots(), data)
    return fig


def _map(ax: Axes, data: xr.Dataset) -> None:
    field = str(data["field"].item())
    measured = data.assign_coords(step=data["value"].values).rename(step=field)
    K0, other = measured["K0"].values, measured[field].values
    colours = ListedColormap([SETTLED, CYCLE])
    cells(ax, measured["cycles"].astype(float), "K0", field, cmap=colours, vmin=0, vmax=1)
    ax.set_ylabel(label(field))
    for name, colour, dashes, text in (
        ("closed", "#D55E00", "-", "closed form"),
        ("linear", "black", "--", "sampled linear loop"),
    ):
        inside = measured[name].transpose(field, "K0").values.astype(float)
        ax.contour(K0, other, inside, [0.5], colors=colour, linewidths=1.2, linestyles=dashes)
        ax.plot([], [], color=colour, lw=1.2, ls=dashes, label=text)


def _stripe(ax: Axes, data: xr.Dataset) -> None:
    """Algorithm 1 as printed against one slope throughout, where its two rests cross |e| = x0."""
    K0 = data["stripe_K0"].values
    for law, (colour, dashes) in LAWS.items():
        ax.plot(
            K0, data["stripe_tail"].sel(law=law), color=colour, ls=dashes, lw=0.9, label=NAMES[law]
        )
    ax.axvspan(*data["stripe_ends"].values, color="0.88", zorder=0, label="no rest, by formula")
    ax.set_yscale("log")
    ax.set(xlim=(K0[0], K0[-1]), xlabel=label("K0"), ylabel="nmse, last 10 of 20 s")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, title="law")
