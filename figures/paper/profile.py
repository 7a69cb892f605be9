"""The force profile and how soon it saturates (eq. 1): 99.9 % of Fmax before xb."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from fic_jax import Params, force
from figures import signal, style
from figures.paper import look

STATED = 1e-3  # what the text leaves to Fmax before xb: 0.1 %
LARGEST = 0.15  # rad
NOTE: dict[str, Any] = {"fontsize": style.SMALL_SIZE, "color": look.REFERENCE}


def compute(stiffnesses: tuple[float, ...] = look.STIFFNESSES, n: int = 6001) -> xr.Dataset:
    """F_K (N*m) over the error (rad) for each K0, in float64."""
    with jax.enable_x64(True):
        e = np.linspace(0.0, LARGEST, n)
        rows = [np.asarray(force(e, replace(look.PAPER, K0=K0))) for K0 in stiffnesses]
    return xr.Dataset({"force": (("K0", "e"), np.stack(rows))}, {"K0": list(stiffnesses), "e": e})


def plot(data: xr.Dataset, params: Params = look.PAPER) -> Figure:
    """The profile for each K0, and what it lacks to Fmax between x0 and xb."""
    with style.look():
        fig = Figure(figsize=(style.COLUMN_WIDTH, 3.9))
        above, below = fig.subplots(2, 1)
        curves = []
        for K0, colour, dashes in zip(
            data["K0"].values, style.ordered(data.sizes["K0"]), style.DASHES, strict=False
        ):
            F = data["force"].sel(K0=K0)
            line: dict[str, Any] = {"color": colour, "ls": dashes, "lw": 1.0}
            above.plot(data["e"], F, label=look.values("K0", [K0])[0], **line)
            curves.append((data["e"].values, F.values, colour))
            lacking = abs(1.0 - F / params.Fmax)
            below.plot(data["e"], lacking.where(lacking > 0), **line)
        above.axhline(params.Fmax, color=look.REFERENCE, lw=0.5, zorder=0)
        above.set(xlim=(0.0, LARGEST), ylim=(0.0, 1.3 * params.Fmax), ylabel="torque $F_K$ (N·m)")
        signal.mark_cut(above, curves)
        below.axhline(STATED, color=look.REFERENCE, lw=0.7, ls=(0, (4, 2)))
        below.set(xlim=(0.099, 0.111), yscale="log", ylim=(1e-10, 10.0))
        below.set_ylabel(r"$|1 - F_K/F_{Max}|$")
        for ax in (above, below):
            ax.set_xlabel(r"error $|\tilde{x}|$ (rad)")
            look.mark_bounds(ax, params)
        below.text(0.107, STATED, "99.9 % of " + style.SYMBOLS["Fmax"], va="bottom", **NOTE)
        place: dict[str, Any] = {"loc": "outside upper center", "ncols": 2, "frameon": False}
        handles, labels = above.get_legend_handles_labels()
        handles.append(Line2D([], [], color="0.3", ls="", marker="^", ms=4, mew=0))
        fig.legend(handles, [*labels, signal.CUT], **place)
    return fig


def figures() -> Iterator[tuple[str, Figure]]:
    """The profiles of the paper's stiffnesses."""
    yield "profile", plot(compute())
