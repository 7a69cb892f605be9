"""The convergence time over controller and environment, for torques and dampings."""

import xarray as xr
from matplotlib.figure import Figure

from figures.atlas import nmse
from figures.atlas.numbers import converged, percent

SWEEPS = nmse.SWEEPS
TITLE = "Convergence time over stiffnesses, damping and torque"
ALT = "Sixteen maps of the convergence time over Kenv and K0, as before, at sigma = 0.01"
X0 = 0.10  # rad, of the sweep


def plot(atlas: xr.Dataset) -> Figure:
    """Convergence time over Kenv and K0, in rows of Td and columns of Denv."""
    return nmse.plot(atlas, "convergence_time")


def finding(atlas: xr.Dataset) -> str:
    """Soft and stiff controllers in the least and in the most damped environment."""
    data = converged(atlas.sel(sigma=nmse.SIGMA, Td=list(nmse.TORQUES), Denv=list(nmse.DAMPINGS)))
    soft = data["K0"] * X0 < data["Td"]
    all_, of_soft, of_stiff = (
        [percent(float(data.where(part).sel(Denv=D).mean())) for D in (1.0, 1000.0)]
        for part in (xr.ones_like(soft), soft, ~soft)
    )
    return (
        f"The torque converges in {all_[0]} of the cells at Denv = 1 and in {all_[1]} at "
        f"1000 N·m·s/rad. "
        f"Where damping is low, stiff controllers converge more often than soft ones, whose first "
        f"reference Td/K0 lies beyond x0 ({of_stiff[0]} and {of_soft[0]}); where it is high, soft "
        f"ones do ({of_soft[1]}, and {of_stiff[1]} of the stiff ones)."
    )
