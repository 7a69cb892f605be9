"""Torque, torque error and position over time: welded, contact, stiffness, damping (fig:6-9)."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from figures import signal, style
from figures.paper import look
from sweeps.paper.scenarios import LOCATED, motions, scenarios

STUDIES = {  # picture -> sweep, its rows (those that the captions name), the field of the lines
    "history_welded": ("paper-welded", "Td in [1, 5, 20]", "K0"),
    "history_contact": ("paper-contact", "Td in [1, 5, 20]", "K0"),
    "history_stiffness": ("paper-stiffness", "Td == 5", "Kenv"),
    "history_damping": ("paper-damping", "Td == 5", "Denv"),
}
WIDTH = 400.0  # point, of the columns together
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
        wide = columns.size > 1
        fig = Figure(figsize=(style.PAGE_WIDTH if wide else style.COLUMN_WIDTH, 4.9))
        grid = fig.subplots(3, columns.size, sharex=True, squeeze=False)
        marks: set[str] = set()
        for column, Td in zip(grid.T, columns, strict=True):
            column[-1].set(xlabel=r"$t$ (s)", xlim=(0.0, round(float(data["time"].max()), 6)))
            marks |= _column(column, data.sel(Td=Td), field, WIDTH / columns.size)
            column[0].set_title(look.values("Td", [Td])[0])
        rows = ("torque $T$ (N·m)", r"torque error $\tilde{T}$ (N·m)", "position $x$ (rad)")
        for ax, text in zip(grid[:, 0], rows, strict=True):
            ax.set_ylabel(text)
        fig.align_ylabels()
        handles, labels = grid[0, 0].get_legend_handles_labels()
        if signal.LABEL in marks:
            handles.append(Line2D([], [], color=look.REFERENCE, alpha=signal.BAND, lw=6))
            labels.append(signal.LABEL)
        if signal.CUT in marks:
            handles.append(Line2D([], [], color=look.REFERENCE, ls="", marker="^", ms=4, mew=0))
            labels.append(signal.CUT)
        place: dict[str, Any] = {"loc": "outside upper center", "frameon": False}
        place |= {"ncols": min(len(handles), 3 if wide else 2)}
        fig.legend(handles, labels, title=look.step(data.attrs["period"]), **place)
    return fig


def _column(axes: np.ndarray, runs: xr.Dataset, field: str, width: float) -> set[str]:
    """Draw one Td; returns the legend's texts of the marks used."""
    torque, error, position = axes
    Td = float(runs["Td"])
    Fmax, gap = look.PAPER.Fmax, runs.attrs["gap"]
    values, t = runs[field].values, runs["time"].values
    errors, bands = [], False
    for value, text, colour, dashes in zip(
        values, look.values(field, values), style.ordered(values.size), style.DASHES, strict=False
    ):
        run, kind = runs.sel({field: value}), {"color": colour, "ls": dashes, "lw": 0.8}
        T = run["tau_env"].values
        for ax, y, label in ((torque, T, text), (error, T - Td, None), (position, run["x"], None)):
            bands |= signal.draw(ax, t, np.asarray(y), width, label=label, **kind)
        errors.append((t, T - Td, colour))
    thin = {"color": look.REFERENCE, "lw": 0.5, "zorder": 0}
    torque.axhline(Td, label="set value, limit, environment", **thin)
    error.axhline(0.0, **thin)
    position.axhline(gap, **thin)
    if Td > Fmax:
        torque.axhline(Fmax, **thin)
        error.axhline(Fmax - Td, **thin)
    _zoom(error, runs["tau_env"].values - Td)
    cut = signal.mark_cut(error, errors)
    return ({signal.LABEL} if bands else set()) | ({signal.CUT} if cut else set())


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
