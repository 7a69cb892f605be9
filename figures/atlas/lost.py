"""Where contact, once made, is lost: over the environment's stiffness and damping."""

import xarray as xr
from matplotlib.figure import Figure

from figures import heatmap
from figures.atlas.numbers import percent, trusted_values
from figures.planes import select

SWEEPS = ("atlas-lost",)
TITLE = "Loss of contact after an approach"
ALT = "Three maps of the time out of contact over Kenv and Denv, by stiffness of the controller"
K0, STIFF = 100.0, (100.0, 500.0, 1000.0)  # N*m/rad, of the second sentence


def plot(data: xr.Dataset) -> Figure:
    """Time out of contact over Kenv and Denv, in columns of K0."""
    row = [
        ("", select(data, x="Kenv", y="Denv", metric="contact_lost", at={"K0": K}))
        for K in data["K0"].values
    ]
    return heatmap.grid([row])


def needed(data: xr.Dataset, Kenv: float) -> float:
    """The least damping from which contact is never lost, whatever the damping above it."""
    time = data["contact_lost"].sel(K0=K0).sel(Kenv=Kenv, method="nearest")
    lost = time["Denv"].where(time > 0).max()
    return float(time["Denv"].where(~(time["Denv"] <= lost)).min())


def finding(data: xr.Dataset) -> str:
    """The share of environments that keep the joint, and the damping which that takes."""
    kept = trusted_values(data, "contact_lost") == 0
    share = [percent(float(kept.sel(K0=K).mean())) for K in data["K0"].values]
    stiff = ", ".join(f"{K:g}" for K in data["K0"].values)
    damping = ", ".join(f"{needed(data, K):.0f}" for K in STIFF)
    return (
        f"That contact is never lost, as the paper says of its three environments, is known to "
        f"hold in {', '.join(share)} of the environments at K0 = {stiff} N·m/rad. "
        f"The stiffer the environment, the more damping this takes: at K0 = {K0:g} it is "
        f"{damping} N·m·s/rad for Kenv = {', '.join(f'{K:g}' for K in STIFF)} N·m/rad."
    )
