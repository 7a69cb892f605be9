"""Normalised torque error over K0 and Td (fig:4): welded beside hard stop."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from figures import style
from figures.paper import look
from sweeps.paper.scenarios import LOCATED, measured, scenarios, trusted_only

TITLES = {"welded": "welded", "hard_stop": "contact (hard stop)"}  # left, right
ROWS = {"nmse": "whole run", "nmse_tail": "last 5 s"}
# What the text states, by panel: "below 1e-1", "below 1e-4", "about 1e-1 even at the regime".
STATED = {
    ("welded", "nmse"): 1e-1,
    ("welded", "nmse_tail"): 1e-4,
    ("hard_stop", "nmse_tail"): 1e-1,
}
SPREAD = 0.66  # of the distance between two Td, taken by the markers of one


def simulate(step: float) -> xr.Dataset:
    """Both columns; `xd` 0 is the true distance of the environment, 0.001 rad the 1 % error.

    A value that is not trusted is no number of the motion, and left out.
    """
    rows = scenarios("paper-welded", "paper-contact", xd=(0.0, look.ESTIMATE_ERROR), period=[step])
    found = trusted_only(measured(rows, LOCATED.model, step), list(ROWS))
    cells = found.set_index(["contact", "xd", "K0", "Td"])
    return cells[list(ROWS)].to_xarray().assign_attrs(period=step)


def plot(data: xr.Dataset) -> Figure:
    """nmse above, nmse_tail below; both columns share the logarithmic scales."""
    columns = list(TITLES)
    with style.look():
        fig = Figure(figsize=(style.PAGE_WIDTH, 4.2))
        shape: dict[str, Any] = {"squeeze": False, "height_ratios": (1.0, 1.5)}
        grid = fig.subplots(len(ROWS), len(columns), sharex=True, sharey="row", **shape)
        for row, metric in zip(grid, ROWS, strict=True):
            for ax, contact in zip(row, columns, strict=True):
                _draw(ax, data[metric].sel(contact=contact))
                _stated(ax, STATED.get((contact, metric)))
            row[0].set(yscale="log", ylim=look.decades(data[metric].values))
            row[0].set_ylabel(f"normalised MSE,\n{ROWS[metric]}")
        for ax, contact in zip(grid[0], columns, strict=True):
            ax.set_title(TITLES[contact])
        for ax in grid[-1]:
            ax.set_xlabel(look.label("Td"))
        fig.suptitle(look.step(data.attrs["period"]))
        fig.legend(handles=_legend(data), loc="outside right upper", frameon=False)
    return fig


def _draw(ax: Axes, plane: xr.DataArray) -> None:
    """A group for each Td, in it a place for each K0: a mark if exact, a dash the 1 % error."""
    stiffnesses, torques = plane["K0"].values, plane["Td"].values
    colours = style.ordered(stiffnesses.size)
    places = SPREAD * (np.arange(stiffnesses.size) / max(stiffnesses.size - 1, 1) - 0.5)
    for K0, place, colour, marker in zip(stiffnesses, places, colours, look.MARKERS, strict=False):
        x = np.arange(torques.size) + place
        for estimate in plane["xd"].values:
            y = plane.sel(K0=K0, xd=estimate).values
            kind = {"marker": marker, "color": colour} | _kind(estimate)
            ax.plot(x, y, ls="", **kind)
    ax.set_xticks(range(torques.size), [f"{Td:g}" for Td in torques])
    ax.tick_params(axis="x", length=0)
    for between in np.arange(torques.size - 1) + 0.5:
        ax.axvline(between, color="0.88", lw=0.5, zorder=0)


def _kind(estimate: float) -> dict[str, Any]:
    if estimate == 0.0:
        return {"ms": 3.6, "mew": 0.0}
    return {"marker": "_", "ms": 7.0, "mew": 1.0, "zorder": 2.5}


def _stated(ax: Axes, bound: float | None) -> None:
    if bound is not None:
        ax.axhline(bound, color=look.REFERENCE, lw=0.7, ls=(0, (4, 2)), zorder=0)


def _legend(data: xr.Dataset) -> list[Line2D]:
    named = zip(data["K0"].values, style.ordered(data.sizes["K0"]), look.MARKERS, strict=False)
    lines = [
        Line2D([], [], ls="", marker=m, color=c, ms=4, label=look.values("K0", [K0])[0])
        for K0, c, m in named
    ]
    texts = {0.0: "exact contact", look.ESTIMATE_ERROR: "1 % error"}
    for estimate in data["xd"].values:
        kind = _kind(estimate)
        text = f"{texts[float(estimate)]},\n{look.values('xd', [estimate])[0]}"
        lines.append(Line2D([], [], ls="", label=text, **{"marker": "o", "color": "0.3"} | kind))
    dashes: dict[str, Any] = {"color": look.REFERENCE, "lw": 0.7, "ls": (0, (4, 2))}
    lines.append(Line2D([], [], label="stated in the text", **dashes))
    return [*lines, Line2D([], [], ls="", label="no mark: not trusted")]


def figures() -> Iterator[tuple[str, Figure]]:
    """Both columns at either step."""
    for ending, step in look.STEPS.items():
        yield f"mse_contact{ending}", plot(simulate(step))
