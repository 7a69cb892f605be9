"""The approach to a hard stop that is not where it is expected: gap by error of xd."""

import itertools

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import heatmap
from figures.atlas.numbers import converged
from figures.planes import select

SWEEPS = ("atlas-expected",)
TITLE = "Gap and error of the expected contact"
ALT = "Maps of steady error and convergence time over the gap and the error of xd, by stiffness"
ROWS = {"steady_error": "steady error / $T_d$", "convergence_time": "convergence time"}
LARGEST = 0.3  # rad, either way
DEEP = 0.1  # rad, the error of the second sentence


def by_error(data: xr.Dataset) -> xr.Dataset:
    """The sweep over gap and xd as one over gap and xd_error = xd - gap; both have one spacing."""
    xd, gap = data["xd"].values, data["gap"].values
    step = float(gap[1] - gap[0])
    n = round(LARGEST / step)
    errors = np.round(np.arange(-n, n + 1) * step, 12)
    at = np.round((gap[None, :] + errors[:, None] - xd[0]) / step).astype(int)
    index = xr.DataArray(at, dims=("xd_error", "gap"))
    inside = data.isel(xd=index, gap=xr.DataArray(np.arange(gap.size), dims="gap"))
    named = inside.drop_vars("xd").assign_coords(xd_error=("xd_error", errors), gap=data["gap"])
    named["xd_error"].attrs = {"units": data["xd"].attrs["units"], "long_name": "error of xd"}
    return named


def plot(data: xr.Dataset) -> Figure:
    """Steady error above convergence time, over gap and error of xd, in columns of K0."""
    shown = by_error(data)
    for metric, words in ROWS.items():
        shown[metric] = shown[metric].assign_attrs(long_name=words)
    rows = [
        [
            select(shown, x="gap", y="xd_error", metric=metric, at={"K0": K})
            for K in data["K0"].values
        ]
        for metric in ROWS
    ]
    return heatmap.grid([[("", plane) for plane in row] for row in rows], row_height=1.7)


def longest(good: xr.DataArray) -> tuple[float, float]:
    """The ends of the longest run of errors with which all is good."""
    runs = itertools.groupby(good["xd_error"].values, key=lambda e: bool(good.sel(xd_error=e)))
    errors = max((list(run) for fine, run in runs if fine), key=len)
    return float(errors[0]), float(errors[-1])


def finding(data: xr.Dataset) -> str:
    """The errors with which the torque converges from every gap, and what larger ones do."""
    shown = by_error(data)
    good = converged(shown).all("gap")
    spans = []
    for K in data["K0"].values:
        low, high = longest(good.sel(K0=K))
        span = f"{low:g} to {high:g}" if high > low else f"{low:g}"
        spans.append(f"{span} rad at K0 = {K:g}")
    steady = shown["steady_error"].median("gap")
    deep = ", ".join(f"{float(v):.1f}" for v in steady.sel(xd_error=DEEP))
    stiff = float(steady.sel(xd_error=-DEEP).isel(K0=-1))
    return (
        f"From every gap the torque converges with an error xd − gap of "
        f"{', '.join(spans)} N·m/rad. "
        f"A contact that is expected {DEEP:g} rad too deep is pressed too hard, by {deep} times Td "
        f"(medians); one that is expected {DEEP:g} rad too early costs time, and the stiffest "
        f"joint ends with a torque error of {stiff:.1f} Td: it does not arrive.".replace("-", "−")
    )
