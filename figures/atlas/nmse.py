"""The error of the torque over controller and environment, for torques and dampings."""

import xarray as xr
from matplotlib.figure import Figure

from figures import heatmap
from figures.atlas.numbers import percent, trusted_values
from figures.planes import select

SWEEPS = ("atlas",)
TITLE = "Error over stiffnesses, damping and torque"
ALT = "Sixteen maps of nmse over Kenv and K0, by torque and damping, at sigma = 0.01"
TORQUES = (1.0, 5.0, 10.0, 20.0)  # N*m, rows; the last is beyond Fmax
DAMPINGS = (1.0, 10.0, 100.0, 1000.0)  # N*m*s/rad, columns
SIGMA = 0.01  # the paper's
SMALL = 0.01  # nmse at the lines


def plot(atlas: xr.Dataset, metric: str = "nmse") -> Figure:
    """A metric over Kenv and K0, in rows of Td and columns of Denv."""
    rows = [
        [
            select(atlas, x="Kenv", y="K0", metric=metric, at={"Td": Td, "Denv": D, "sigma": SIGMA})
            for D in DAMPINGS
        ]
        for Td in TORQUES
    ]
    return heatmap.grid([[("", plane) for plane in row] for row in rows], row_height=1.5)


def finding(atlas: xr.Dataset) -> str:
    """What the damping decides, and what the saturation torque does."""
    nmse = trusted_values(atlas.sel(sigma=SIGMA, Td=list(TORQUES), Denv=list(DAMPINGS)), "nmse")
    reached = nmse.sel(Td=list(TORQUES[:-1]))
    share = [percent(float((reached.sel(Denv=D) <= SMALL).mean())) for D in (1.0, 100.0, 1000.0)]
    return (
        f"The damping of the environment decides most: with σ = {SIGMA:g} and torques up to "
        f"10 N·m, an nmse of at most {SMALL:g} is reached in {share[0]} of the cells at Denv = 1, "
        f"in {share[1]} at 100 and in {share[2]} at 1000 N·m·s/rad. "
        f"At Td = 20 N·m, which the saturation torque of 15 N·m does not reach, the smallest nmse "
        f"of all cells is {float(nmse.sel(Td=TORQUES[-1]).min()):.2g}."
    )
