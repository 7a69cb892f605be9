"""The largest torque of an impact over speed and stiffness, for dampings."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray

from figures import heatmap
from figures.atlas.numbers import trusted_values
from figures.planes import Plane, select

SWEEPS = ("atlas-impact",)
TITLE = "Peak torque of an impact"
ALT = "Four maps of the peak torque over impact speed and Kenv, by damping"
INERTIA, FMAX = 10.0, 15.0  # kg*m^2, N*m, of the sweep
HARD = 30.0  # N*m, impacts of the first sentence
RULE = r"$v\,\max(D_{env}, \sqrt{I\,K_{env}}) = F_{Max}$"


def rule(v: xr.DataArray, Kenv: xr.DataArray, Denv: float) -> xr.DataArray:
    """The torque of a free body at a damper at once, or at a spring when it has stopped."""
    return v * np.maximum(Denv, np.sqrt(INERTIA * Kenv))


def at_fmax(plane: Plane) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Speed and Kenv at which the rule gives Fmax."""
    Kenv = plane.y.edges
    return FMAX / np.maximum(float(plane.cut["Denv"]), np.sqrt(INERTIA * Kenv)), Kenv


def plot(data: xr.Dataset) -> Figure:
    """Peak torque over impact speed and Kenv, in columns of Denv."""
    row = [
        ("", select(data, x="v_init", y="Kenv", metric="peak_torque", at={"Denv": D}))
        for D in data["Denv"].values
    ]
    return heatmap.grid([row], lines={RULE: at_fmax})


def finding(data: xr.Dataset) -> str:
    """How far the rule holds, and where a gentle touch ends in hard ones."""
    peak = trusted_values(data, "peak_torque")
    ratio = []
    for D in data["Denv"].values:
        hard = rule(data["v_init"], data["Kenv"], D)
        ratio.append((peak.sel(Denv=D) / hard).where(hard > HARD).values.ravel())
    low, high = np.nanquantile(np.concatenate(ratio), [0.05, 0.95])
    v = float(data["v_init"].min())
    gentle = peak.sel(Denv=0.0, v_init=v)
    from_here = float(gentle["Kenv"].where(gentle > FMAX).min())
    return (
        f"An impact is that of a free body on a damper or a spring: where v max(Denv, √(I Kenv)) "
        f"exceeds {HARD:g} N·m, nine of ten peaks are {low:.2f} to {high:.2f} times this. "
        f"Without damping even a touch at {v:g} rad/s exceeds the saturation torque from "
        f"Kenv = {from_here:.0f} N·m/rad on, where the joint also loses contact."
    )
