"""Torque, torque error and position over time: welded, contact, stiffness, damping (fig:6-9)."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fic_jax import Model
from figures import style
from figures.paper import look, studies

GRID = {"Td": (1.0, 5.0, 20.0), "K0": studies.STIFFNESSES}  # Td: those that the captions name
APPROACH: dict[str, Any] = {"gap": studies.GAP, "xd": studies.GAP}
STUDIES: dict[str, dict[str, Any]] = {
    "history_welded": {"grid": GRID, "model": Model(contact="welded")},
    "history_contact": {"grid": GRID},
    "history_stiffness": {"grid": {"Td": (5.0,), "Kenv": studies.ENVIRONMENTS["Kenv"]}} | APPROACH,
    "history_damping": {"grid": {"Td": (5.0,), "Denv": studies.ENVIRONMENTS["Denv"]}} | APPROACH,
}
SHOWN = (2.0, 98.0)  # percentiles of the torque errors that their row has to hold


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
        place: dict[str, Any] = {"loc": "outside upper center", "ncols": n, "frameon": False}
        fig.legend(*handles, title=studies.told_step(data), **place)
    return fig


def _column(axes: np.ndarray, runs: xr.Dataset, field: str) -> None:
    torque, error, position = axes
    Td = float(runs["Td"])
    Fmax, gap = studies.PAPER.Fmax, runs.attrs.get("gap", studies.PAPER.gap)
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
    low, high = np.percentile(error[np.isfinite(error)], SHOWN)
    low, high = min(low, 0.0), max(high, 0.0)
    margin = 0.15 * max(high - low, 1e-9)
    ax.set_ylim(low - margin, high + margin)


def main(folder: Path = look.FOLDER) -> list[str]:
    """Simulate the four studies at either step and write a figure of each."""
    return [
        look.write(plot(studies.histories(**study, step=step)), folder, name + ending)
        for name, study in STUDIES.items()
        for ending, step in studies.STEPS.items()
    ]


if __name__ == "__main__":
    main()
