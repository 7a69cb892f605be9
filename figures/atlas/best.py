"""The best search resolution in the worst case, and what it costs to use 0.01 instead."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import heatmap, reduction, style
from figures.atlas.numbers import percent
from figures.cut import FEW_DOUBTED
from figures.planes import select
from sweeps.store.format import OK

SWEEPS = ("atlas-best", "atlas-usual")
TITLE = "The best sigma, and the cost of 0.01"
ALT = "Maps over Kenv and K0: best sigma, its worst error, and how much larger that of 0.01 is"
CONTACTS = ("welded", "hard_stop")
STIFF = 100.0  # N*m/rad, from here on most worst cases are trusted
ROWS = {
    "best_sigma": r"best $\sigma$",
    "nmse_at_best": "worst nmse with it",
    "cost": "that of 0.01 over it",
}


def with_cost(best: xr.Dataset, usual: xr.Dataset) -> xr.Dataset:
    """The store of the best sigma, with the ratio of the worst case of 0.01 to its own."""
    doubted = np.maximum(best["nmse_untrusted_share"], usual["nmse_untrusted_share"])
    own = best["nmse_status"].where(best["nmse_status"] != OK, usual["nmse_status"])
    data = best.assign(
        cost=usual["nmse_max"] / best["nmse_at_best"],
        cost_status=own.astype("uint8"),
        cost_untrusted_share=doubted,
    )
    data["cost"].attrs = {"units": "1", "ancillary_variables": "cost_status"}
    for name, words in ROWS.items():
        data[name] = data[name].assign_attrs(long_name=words)
    return data


def plot(best: xr.Dataset, usual: xr.Dataset) -> Figure:
    """Best sigma, its worst nmse and the cost of 0.01, each welded beside hard stop."""
    data = with_cost(best, usual)
    rows = [
        [select(data, x="Kenv", y="K0", metric=m, at={"contact": c}) for c in CONTACTS]
        for m in ROWS
    ]
    drawn = [[("", plane) for plane in row] for row in rows]
    return heatmap.grid(drawn, width=style.COLUMN_WIDTH, row_height=1.5)


def finding(best: xr.Dataset, usual: xr.Dataset) -> str:
    """The range of the best sigma of stiff controllers, and the cost where it is trusted."""
    data = with_cost(best, usual)
    stiff = data.sel(K0=data["K0"] >= STIFF)
    sure = (stiff["cost_status"] == OK) & (stiff["cost_untrusted_share"] <= FEW_DOUBTED)
    cost = stiff["cost"].where(sure)
    one = data["best_sigma"].sel(contact="hard_stop")
    ends = [one.sel(K0=K, Kenv=E, method="nearest") for K, E in ((1000, 10), (100, 1000))]
    sweep, _ = reduction.reduced(best) or (None, None)
    assert sweep
    bottom = float(sweep.outermost("sigma").min())
    at_bottom = float((one == bottom).sum() / one.notnull().sum())
    most, least = (f"{float(end):.2g}" for end in ends)
    return (
        f"No one σ is best: on a hard stop it falls from {most} at K0 = 1000, Kenv = 10 to "
        f"{least} at K0 = 100, Kenv = 1000 N·m/rad (the sweep ends at {bottom:g}, the best of "
        f"{percent(at_bottom)} of the cells that have one). "
        f"From K0 = {STIFF:g} N·m/rad on, where the worst cases are trusted, σ = 0.01 has a worst "
        f"nmse of {float(cost.median()):.2g} times that of the best in the median, and of "
        f"{float(cost.max()):.0f} times at most."
    )
