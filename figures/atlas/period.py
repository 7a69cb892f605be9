"""The convergence time over the search resolution and the control period."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import heatmap
from figures.atlas.numbers import converged, percent
from figures.planes import select

SWEEPS = ("atlas-period",)
TITLE = "Search resolution and control period"
ALT = "Six maps of the convergence time over sigma and period, by stiffness and contact"
SLOW = 0.01  # s, periods from here on enter the number: below, sigma has its smallest value
WIDE, LONG = 0.3, 0.15  # sigma and period (s) of the corner where the step is too wide


def plot(data: xr.Dataset) -> Figure:
    """Convergence time over sigma and period, in rows of the contact and columns of K0."""
    rows = [
        [
            select(
                data, x="sigma", y="period", metric="convergence_time", at={"contact": c, "K0": K}
            )
            for K in data["K0"].values
        ]
        for c in data["contact"].values
    ]
    return heatmap.grid([[("", plane) for plane in row] for row in rows], row_height=1.7)


def least_rate(data: xr.Dataset) -> xr.DataArray:
    """The smallest sigma/period (1/s) that converges on a hard stop, of each K0 and period."""
    good = converged(data.sel(contact="hard_stop", period=data["period"] >= SLOW))
    return good["sigma"].where(good).min("sigma") / good["period"]


def finding(data: xr.Dataset) -> str:
    """The rate at the border, and the corner where a soft controller fails."""
    rates = [f"{float(rate):.2g}" for rate in least_rate(data).median("period")]
    corner = converged(
        data.sel(K0=10.0, sigma=data["sigma"] >= WIDE, period=data["period"] >= LONG)
    )
    stiff = ", ".join(f"{K:g}" for K in data["K0"].values)
    return (
        f"The border is a line of slope 1, so that σ/period decides and neither alone: the "
        f"smallest ratio that converges on a hard stop is {', '.join(rates)} 1/s at K0 = {stiff} "
        f"N·m/rad (median of the periods from {1000 * SLOW:g} ms on). "
        f"At K0 = 10 N·m/rad too wide a step fails as well: with σ ≥ {WIDE:g} and a period of "
        f"{LONG:g} s or more, {percent(float(np.mean(corner)))} of the cells converge."
    )
