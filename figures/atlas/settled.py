"""The share of environments in which a controller settles, over its stiffness and its sigma."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray

from figures import heatmap
from figures.atlas.numbers import percent
from figures.planes import Plane, select

SWEEPS = ("atlas-settled",)
TITLE = "Environments in which a controller settles"
ALT = "Six maps of the share of environments that settle over sigma and K0, by torque and contact"
X0 = 0.10  # rad, of the sweep
STIFFNESSES = (100.0, 316.0, 1000.0)  # N*m/rad, of the first sentence, to the nearest value
LINE = r"$K_0 \tilde{x}_0 = T_d$"


def at_x0(plane: Plane) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sigma and the stiffness whose first reference Td/K0 is x0."""
    return plane.x.edges[[0, -1]], np.full(2, float(plane.cut["Td"]) / X0)


def plot(data: xr.Dataset) -> Figure:
    """Share of settled environments over sigma and K0, in rows of contact and columns of Td."""
    shown = data.assign(
        settled_share=data["settled_share"].assign_attrs(long_name="share of environments")
    )
    rows = [
        [
            select(shown, x="sigma", y="K0", metric="settled_share", at={"contact": c, "Td": Td})
            for Td in data["Td"].values
        ]
        for c in data["contact"].values
    ]
    drawn = [[("", plane) for plane in row] for row in rows]
    return heatmap.grid(drawn, row_height=1.7, lines={LINE: at_x0})


def finding(data: xr.Dataset) -> str:
    """The best sigma of each stiffness, and the share that the paper's reaches."""
    share = data["settled_share"].sel(contact="hard_stop", Td=5.0)
    best = share.idxmax("sigma").sel(K0=list(STIFFNESSES), method="nearest")
    top = float(share.sel(K0=1000.0).max())
    usual = float(share.sel(K0=1000.0).sel(sigma=0.01, method="nearest"))
    soft = share.sel(K0=share["K0"] * X0 < 0.9 * 5.0)
    return (
        f"The stiffer the controller, the larger the σ with which it settles in most environments "
        f"(hard stop, Td = 5 N·m: {', '.join(f'{float(s):.2g}' for s in best)} at K0 = "
        f"{', '.join(f'{float(K):.0f}' for K in best['K0'])} N·m/rad); at K0 = 1000 it is "
        f"{percent(top)} of them, with σ = 0.01 only {percent(usual)}. "
        f"A controller below the line, whose first reference Td/K0 lies beyond x0, settles in at "
        f"most {percent(float(soft.max()))}, whatever its σ."
    )
