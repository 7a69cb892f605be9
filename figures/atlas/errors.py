"""The estimated error of nmse of both integrators over controller and environment."""

import xarray as xr
from matplotlib.figure import Figure

from figures import heatmap
from figures.atlas.numbers import percent
from figures.planes import select
from sweeps.store.format import TRUSTED

SWEEPS = ("atlas-errors",)
TITLE = "Which cells to trust"
ALT = "Eight maps of the estimated relative error of nmse over Kenv and K0, by damping, integrator"


def relative(data: xr.Dataset) -> xr.Dataset:
    """The sweep, its error of nmse relative to nmse."""
    error = (data["nmse_error"] / data["nmse"]).assign_attrs(units="1")
    return data.assign(nmse_error=error.assign_attrs(long_name="estimated relative error of nmse"))


def plot(data: xr.Dataset) -> Figure:
    """Relative error of nmse over Kenv and K0, in rows of the integrator and columns of Denv."""
    shown = relative(data)
    rows = [
        [
            select(shown, x="Kenv", y="K0", metric="nmse_error", at={"integrator": i, "Denv": D})
            for D in data["Denv"].values
        ]
        for i in data["integrator"].values
    ]
    return heatmap.grid([[("", plane) for plane in row] for row in rows], row_height=1.7)


def finding(data: xr.Dataset) -> str:
    """The share of trusted cells and the median error of both integrators."""
    shown = relative(data)
    trusted = (data["nmse_trusted"] == TRUSTED).mean(["Denv", "K0", "Kenv"])
    median = shown["nmse_error"].median(["Denv", "K0", "Kenv"])
    (one, other), (coarse, fine) = (
        [float(of.sel(integrator=i)) for i in ("rk4", "rk4_events")] for of in (trusted, median)
    )
    soft = data["nmse_trusted"].sel(integrator="rk4_events", K0=data["K0"] < 50.0)
    doubted = float((soft != TRUSTED).sum())
    all_ = float((data["nmse_trusted"].sel(integrator="rk4_events") != TRUSTED).sum())
    return (
        f"Locating the switches inside the step lowers the median relative error of nmse from "
        f"{coarse:.1g} to {fine:.1g}, and {percent(other)} of the cells are trusted instead of "
        f"{percent(one)}. "
        f"Of those that are not trusted then, {percent(doubted / all_)} have K0 below 50 N·m/rad."
    )
