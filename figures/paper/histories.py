"""Torque, torque error and position over time: welded, contact, stiffness, damping (Fig. 6-9)."""

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fic_jax import Model, Params
from figures import style
from figures.paper import look, studies

TORQUES = (1.0, 5.0, 20.0)  # N*m, those that the captions name
GRID = {"Td": TORQUES, "K0": studies.STIFFNESSES}
APPROACH = {"Td": (5.0,)}  # N*m
SHOWN = (2.0, 98.0)  # percentiles of the torque errors that their row has to hold
NAMES = {
    "fig6-welded": "welded",
    "fig7-contact": "contact",
    "fig8-stiffness": "stiffness",
    "fig9-damping": "damping",
}


def simulate(name: str) -> xr.Dataset:
    """One of the four studies: a column for each Td, a line for each value of its field."""
    gap = studies.GAP
    return {
        "fig6-welded": lambda: studies.histories(GRID, model=Model(contact="welded")),
        "fig7-contact": lambda: studies.histories(GRID),
        "fig8-stiffness": lambda: studies.histories(
            APPROACH | {"Kenv": (50.0, 100.0, 500.0)}, gap=gap, xd=gap
        ),
        "fig9-damping": lambda: studies.histories(
            APPROACH | {"Denv": (0.0, 63.2, 189.7)}, gap=gap, xd=gap
        ),
    }[name]()


def plot(data: xr.Dataset) -> Figure:
    """Three rows over 10 s; a column for each Td, a line for each value of the other field.

    Thin lines mark Td, the saturation torque, the error that it leaves, and the environment.
    """
    field = next(str(name) for name in data["torque"].dims if name not in ("Td", "t"))
    columns = data["Td"].values
    with rc_context(style.RC):
        width = style.PAGE_WIDTH if columns.size > 1 else style.COLUMN_WIDTH
        fig = Figure(figsize=(width, 4.6))
        grid = fig.subplots(3, columns.size, sharex=True, squeeze=False)
        for column, Td in zip(grid.T, columns, strict=True):
            _column(column, data.sel(Td=Td), field)
            column[0].set_title(look.values("Td", [Td])[0])
            column[-1].set(xlabel=r"$t$ (s)", xlim=(0.0, round(float(data["t"].max()), 6)))
        rows = ("torque $T$ (N·m)", r"torque error $\tilde{T}$ (N·m)", "position $x$ (rad)")
        for ax, text in zip(grid[:, 0], rows, strict=True):
            ax.set_ylabel(text)
        fig.align_ylabels()
        handles = grid[0, 0].get_legend_handles_labels()
        n = min(len(handles[0]), 3 if columns.size > 1 else 2)
        fig.legend(*handles, loc="outside upper center", ncols=n, frameon=False)
    return fig


def _column(axes: np.ndarray, runs: xr.Dataset, field: str) -> None:
    torque, error, position = axes
    Td = float(runs["Td"])
    Fmax, gap = (runs.attrs.get(name, getattr(Params(), name)) for name in ("Fmax", "gap"))
    values = runs[field].values
    for value, text, colour, dashes in zip(
        values, look.values(field, values), look.ordered(values.size), look.DASHES, strict=False
    ):
        run, kind = runs.sel({field: value}), {"color": colour, "ls": dashes, "lw": 0.7}
        torque.plot(run["t"], run["torque"], label=text, **kind)
        error.plot(run["t"], run["torque"] - Td, **kind)
        position.plot(run["t"], run["x"], **kind)
    thin = {"color": look.REFERENCE, "lw": 0.5, "zorder": 0}
    torque.axhline(Td, label="set value, limit, environment", **thin)
    error.axhline(0.0, **thin)
    position.axhline(gap, **thin)
    if Td > Fmax:
        torque.axhline(Fmax, **thin)
        error.axhline(Fmax - Td, **thin)
    _zoom(error, runs["torque"].values - Td)


def _zoom(ax: Axes, error: np.ndarray) -> None:
    """Limit the axis to what lasts: a spike is drawn whole one row above."""
    low, high = np.percentile(error, SHOWN)
    low, high = min(low, 0.0), max(high, 0.0)
    margin = 0.15 * max(high - low, 1e-9)
    ax.set_ylim(low - margin, high + margin)


def main() -> None:
    """Simulate the four studies and write a figure of each."""
    for name in NAMES:
        look.write(plot(simulate(name)), name)


if __name__ == "__main__":
    main()
