"""The control period: tail error over K0 and period, and T where the solver chooses its steps."""

import re
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from figures import colours, signal, style
from figures.findings.maps import cells, contour, over, rows
from figures.paper import look
from figures.paper.look import label

SIGMA, Td = 0.01, 5.0  # of the store and of all runs
CONVERGED = 1e-4  # nmse_tail at the lines
SHOWN = (  # runs: the paper's study of contact, then its three approaches
    "pressed, K0 = 100",
    "approach, Kenv = 50",
    "approach, Kenv = 100",
    "approach, Kenv = 500",
)
TAILS = LogNorm(1e-8, 1.0)  # colours of nmse_tail
KINDS = {"Radau": ("#0072B2", "--"), "RK23": ("#D55E00", "-.")}
TOP = 9.0  # N*m; a mark says how far the impact's spike goes, what lasts is the matter


def plot(data: xr.Dataset) -> Figure:
    """Two maps of nmse_tail with the lines of the loop, over four histories of the torque."""
    with style.look():
        fig = Figure(figsize=(style.PAGE_WIDTH, 4.9))
        upper, lower = rows(fig, (1.25, 1.0))
        maps = upper.subplots(1, len(data["contact"]), sharey=True, squeeze=False)[0]
        for ax, contact in zip(maps, data["contact"].values, strict=True):
            mesh = _map(ax, data.sel(contact=contact))
            ax.set(title=str(contact).replace("_", " "), xlabel=label("K0"))
            ax.label_outer()
        extend = colours.extend(data["nmse_tail"].values.ravel(), TAILS)
        bar = upper.colorbar(mesh, ax=list(maps), extend=extend, pad=0.01, aspect=25)
        bar.set_label("nmse of the last 5 s")
        upper.legend(
            *maps[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
        )
        shown = [case for case in SHOWN if case in data["case"].values]
        panels = lower.subplots(1, len(shown), sharey=True, squeeze=False)[0]
        for ax, case in zip(panels, shown, strict=True):
            _history(ax, data.sel(case=case))
            ax.set_title(_title(case))
        panels[0].set_ylabel("torque $T$ (N·m)")
        handles, labels = panels[0].get_legend_handles_labels()
        handles.append(Line2D([], [], color="0.3", ls="", marker="^", ms=4, mew=0))
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": 5, "frameon": False}
        lower.legend(handles, [*labels, signal.CUT], **place)
    return fig


def _title(case: str) -> str:
    """The name of a run, with the symbol and the unit of its value."""
    kind, field, value = re.fullmatch(r"(.*), (.*) = (.*)", case).groups()  # type: ignore[union-attr]
    return f"{kind}\n{look.values(field, [float(value)])[0]}"


def _map(ax: Axes, data: xr.Dataset) -> QuadMesh:
    mesh = cells(ax, data["nmse_tail"], "K0", "period", cmap=style.SEQUENTIAL, norm=TAILS)
    K0, period = data["K0"].values, data["period"].values
    cycles = data["cycles"].transpose("period", "K0").values.astype(float)
    tail = data["linear_tail"].transpose("period", "K0").values
    line = SIGMA / (float(data["gain"]) * K0)
    over(ax, K0, line, ls="--", label=r"tail of $10^{-4}$: $\sigma/(\mathrm{period}\,K_0)$ = const")
    settled = np.where(cycles > 0, np.nan, tail)
    contour(ax, K0, period, settled, CONVERGED, label="the same by the sampled linear loop")
    contour(ax, K0, period, cycles, 0.5, color="#ff5a36", label="limit cycle by the linear loop")
    return mesh


def _history(ax: Axes, run: xr.Dataset) -> None:
    curves = [(run["sample"].values, run["fixed"].values, "0.15")]
    ax.plot(run["sample"], run["fixed"], color="0.15", lw=0.9, label="period 10 ms")
    for solver, (colour, dashes) in KINDS.items():
        T = run.sel(solver=solver)
        curves.append((T["t"].values, T["tau_env"].values, colour))
        ax.plot(T["t"], T["tau_env"], color=colour, ls=dashes, lw=0.9, label=f"steps of {solver}")
    ax.axhline(Td, color="0.55", lw=0.5, zorder=0, label="$T_d$")
    ax.set(xlim=(0.0, 10.0), ylim=(0.0, TOP), xlabel="$t$ (s)")
    signal.mark_cut(ax, curves)
