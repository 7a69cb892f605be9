"""Fmax = Td over the atlas: does saturating at the desired torque remove the residual error?"""

import numpy as np
import pandas as pd
import xarray as xr

from sweeps.store.format import OK

STORES = ("atlas-saturated",)
SETTLED = 1e-4  # nmse_tail below which no residual is left to speak of (C1)
SAME = 0.01  # relative change of nmse_tail that counts as none
METRICS = ("nmse_tail", "steady_error", "convergence_time")
PLANES = (("K0", "Kenv"), ("K0", "Td"), ("K0", "Denv"))
X0 = 0.10  # rad, the sweep's


def measure(atlas: xr.Dataset) -> xr.Dataset:
    """Shares of cells better and worse with Fmax = Td than with the paper's, over three planes.

    `atlas`: the store `atlas-saturated`, its cases first with Fmax = Td, then with Fmax = 15.
    """
    saturated, paper = _halves(atlas)
    change = _decades(saturated["nmse_tail"], paper["nmse_tail"])
    linear = saturated["K0"] * X0 > saturated["Td"]
    data = xr.Dataset()
    for x, y in PLANES:
        rest = [d for d in change.dims if d not in (x, y)]
        data[f"change_{y}"] = change.median(rest)
        data[f"worse_{y}"] = (change > np.log10(1.0 + SAME)).mean(rest)
    parts = {"all": xr.ones_like(linear), "saturating": ~linear, "linear": linear}
    shares = [_shares(saturated, paper, change, where) for where in parts.values()]
    rows = xr.concat(shares, "part").assign_coords(part=list(parts))
    return data.assign(rows.data_vars).assign_attrs(scenarios=int(change.size))


def _halves(atlas: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """The cells with Fmax = Td and with the paper's Fmax, over Td in place of the case."""
    cells = atlas[[*METRICS, "status"]].load()
    n = cells.sizes["case"] // 2
    halves = []
    for part in (slice(0, n), slice(n, None)):
        half = cells.isel(case=part).swap_dims(case="Td").drop_vars(["case", "Fmax"])
        halves.append(half.where(half["status"] == OK))
    return halves[0], halves[1]


def _decades(new: xr.DataArray, old: xr.DataArray) -> xr.DataArray:
    """Decades by which a positive metric grows; below float32's noise both are nothing."""
    least = 1e-12
    ratio = new.astype(float).clip(min=least) / old.astype(float).clip(min=least)
    return ratio.copy(data=np.log10(ratio.values))


def _shares(
    saturated: xr.Dataset, paper: xr.Dataset, change: xr.DataArray, where: xr.DataArray
) -> xr.Dataset:
    """Shares of the cells `where`, and the median factor of what falls and of what grows."""
    inside = where.broadcast_like(change)

    def share(cells: xr.DataArray) -> float:
        return float((cells & inside).sum() / inside.sum())

    small = np.log10(1.0 + SAME)
    times = saturated["convergence_time"], paper["convergence_time"]
    sizes = abs(saturated["steady_error"]), abs(paper["steady_error"])
    values = {
        "cells": float(inside.mean()),
        "better": share(change < -small),
        "worse": share(change > small),
        "steady_better": share(sizes[0] < (1.0 - SAME) * sizes[1]),
        "steady_worse": share(sizes[0] > (1.0 + SAME) * sizes[1]),
        "settled": share(saturated["nmse_tail"] <= SETTLED),
        "settled_paper": share(paper["nmse_tail"] <= SETTLED),
        "faster": share(times[0] < times[1]),
        "slower": share(times[0] > times[1]),
        "median_better": float(10 ** change.where(inside & (change < -small)).median()),
        "median_worse": float(10 ** change.where(inside & (change > small)).median()),
    }
    return xr.Dataset(values)


def rows(data: xr.Dataset) -> pd.DataFrame:
    """The shares of each part, in percent; `harmed`, the least Denv whose median over K0 grows."""
    by_Denv = data["change_Denv"].median("K0")
    shares = 100 * data[[name for name in data if data[name].dims == ("part",)]].to_dataframe()
    factors = {name: shares[name] / 100 for name in ("median_better", "median_worse")}
    return shares.reset_index().assign(
        **{name: factor.to_numpy() for name, factor in factors.items()},
        pairs=data.attrs["scenarios"],
        harmed=float(by_Denv["Denv"].where(by_Denv > 0).min()),
    )


def lines(data: xr.Dataset) -> pd.DataFrame:
    """`rows`, all cells first, then either side of K0 x0 = Td."""
    return rows(data).assign(text=["all", "K0 x0 < Td", "K0 x0 > Td"])
