"""Torque, torque error and position over time: welded, contact, stiffness, damping (fig:6-9)."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import style
from figures.paper import look
from sweeps.paper.scenarios import LOCATED, motions, scenarios

STUDIES = {  # picture -> sweep, its rows (those that the captions name), the field of the lines
    "history_welded": ("paper-welded", "Td in [1, 5, 20]", "K0"),
    "history_contact": ("paper-contact", "Td in [1, 5, 20]", "K0"),
    "history_stiffness": ("paper-stiffness", "Td == 5", "Kenv"),
    "history_damping": ("paper-damping", "Td == 5", "Denv"),
}
SHOWN = (2.0, 98.0)  # percentiles of the torque errors that their row has to hold


def simulate(picture: str, step: float) -> xr.Dataset:
    """Motions of a study over Td, the field of its lines, and time."""
    sweep, query, field = STUDIES[picture]
    rows = scenarios(sweep, period=[step]).query(query)
    found = motions(rows, LOCATED.model, step)[["tau_env", "x"]].reset_coords(drop=True)
    index = pd.MultiIndex.from_frame(rows[["Td", field]])
    over = xr.Coordinates.from_pandas_multiindex(index, "scenario")
    return (
        found.assign_coords(over)
        .unstack("scenario")
        .assign_attrs(gap=rows["gap"].iloc[0], period=step)
    )


def plot(data: xr.Dataset) -> Figure:
    """Three rows over 10 s; a column for each Td, a line for each value of the other field.

    Thin lines mark Td, the saturation torque, the error that it leaves, and the environment.
    """
    field = next(str(name) for name in data["tau_env"].dims if name not in ("Td", "time"))
    columns = data["Td"].values
    with style.look():
        width = style.PAGE_WIDTH if columns.size > 1 else style.COLUMN_WIDTH
        fig = Figure(figsize=(width, 4.6))
        grid = fig.subplots(3, columns.size, sharex=True, squeeze=False)
        for column, Td in zip(grid.T, columns, strict=True):
            _column(column, data.sel(Td=Td), field)
            column[0].set_title(look.values("Td", [Td])[0])
            column[-1].set(xlabel=r"$t$ (s)", xlim=(0.0, round(float(data["time"].max()), 6)))
        rows = ("torque $T$ (N·m)", r"torque error $\tilde{T}$ (N·m)", "position $x$ (rad)")
        for ax, text in zip(grid[:, 0], rows, strict=True):
            ax.set_ylabel(text)
        fig.align_ylabels()
        handles = grid[0, 0].get_legend_handles_labels()
        n = min(len(handles[0]), 3 if columns.size > 1 else 2)
        place: dict[str, Any] = {"loc": "outside upper center", "ncols": n, "frameon": False}
        fig.legend(*handles, title=look.step(data.attrs["period"]), **place)
    return fig


def _column(axes: np.ndarray, runs: xr.Dataset, field: str) -> None:
    torque, error, position = axes
    Td = float(runs["Td"])
    Fmax, gap = look.PAPER.Fmax, runs.attrs["gap"]
    values = runs[field].values
    for value, text, colour, dashes in zip(
        values, look.values(field, values), style.ordered(values.size), style.DASHES, strict=False
    ):
        run, kind = runs.sel({field: value}), {"color": colour, "ls": dashes, "lw": 0.7}
        torque.plot(run["time"], run["tau_env"], label=text, **kind)
        error.plot(run["time"], run["tau_env"] - Td, **kind)
        position.plot(run["time"], run["x"], **kind)
    thin = {"color": look.REFERENCE, "lw": 0.5, "zorder": 0}
    torque.axhline(Td, label="set value, limit, environment", **thin)
    error.axhline(0.0, **thin)
    position.axhline(gap, **thin)
    if Td > Fmax:
        torque.axhline(Fmax, **thin)
        error.axhline(Fmax - Td, **thin)
    _zoom(error, runs["tau_env"].values - Td)


def _zoom(ax: Axes, error: np.ndarray) -> None:
    """Limit the axis to what lasts: a spike is drawn whole one row above."""
    low, high = np.percentile(error[np.isfinite(error)], SHOWN)
    low, high = min(low, 0.0), max(high, 0.0)
    margin = 0.15 * max(high - low, 1e-9)
    ax.set_ylim(low - margin, high + margin)


def figures() -> Iterator[tuple[str, Figure]]:
    """The four studies at either step."""
    for name in STUDIES:
        for ending, step in look.STEPS.items():
            yield f"{name}{ending}", plot(simulate(name, step))
