"""The best search resolution for each environment, against the paper's 0.01 and a rule of thumb."""

import numpy as np
import pandas as pd
import xarray as xr

from fic_jax import Params
from sweeps.paper import formulas
from sweeps.store.opening import OK

STORES = ("search-resolution",)
PAPER = 0.01
FACTOR = 2.0  # sigma within this factor of the best counts as found
METRICS = ("nmse", "nmse_tail", "convergence_time")
LEAST = 1e-10  # nmse below this is rounding in single precision
PERIOD, X0 = 0.01, 0.10  # s, rad: the sweep's


def measure(searched: xr.Dataset) -> xr.Dataset:
    """Best sigma by each metric, what it gains over 0.01 and what the rule of thumb loses.

    `searched`: the store `search-resolution`.
    """
    cells = searched[[*METRICS, "status"]].load()
    sigma = cells["sigma"]
    rule = _rule(cells)
    # where there is no rule the paper's sigma stands in, and nobody reads it
    position = _nearest(sigma, rule.fillna(PAPER))
    data = xr.Dataset({"rule": rule}, attrs={"largest": float(sigma.max())})
    for metric in METRICS:
        values = cells[metric].where(cells["status"] == OK, np.inf).astype(float)
        values = values.clip(min=LEAST)
        least = values.min("sigma")
        data[f"best_{metric}"] = sigma[values.argmin("sigma")].drop_vars("sigma")
        with np.errstate(invalid="ignore"):  # inf/inf where no sigma converges
            paper = values.sel(sigma=PAPER, method="nearest").drop_vars("sigma")
            data[f"gain_{metric}"] = paper / least
            data[f"loss_{metric}"] = values.isel(sigma=position).drop_vars("sigma") / least
    return data


def _rule(cells: xr.Dataset) -> xr.DataArray:
    """The rule of thumb for errors that start in the linear zone, NaN for others."""
    grid = xr.broadcast(*(cells[name] for name in ("Td", "K0", "Kenv", "Denv")))
    Td, K0, Kenv, Denv = (side.values for side in grid)
    sigma = formulas.search_resolution(Params(K0=K0, Kenv=Kenv, Denv=Denv, period=PERIOD))
    return grid[0].copy(data=np.where(Td <= K0 * X0, sigma, np.nan)).drop_attrs()


def _nearest(sigma: xr.DataArray, wanted: xr.DataArray) -> xr.DataArray:
    """Index of the sigma nearest to what is wanted, by ratio."""
    low, step = np.log(float(sigma[0])), np.log(float(sigma[1] / sigma[0]))
    place = np.rint((np.log(wanted) - low) / step).clip(0, sigma.size - 1)
    return place.astype(int)


def table(data: xr.Dataset) -> pd.DataFrame:
    """A row for each stiffness: which sigma, and what it is worth."""
    rows = []
    for K0 in data["K0"].values:
        here = data.sel(K0=K0)
        ruled = here["rule"].notnull()
        low, best, high = here["best_nmse"].quantile([0.1, 0.5, 0.9]).values
        gain = here["gain_nmse"].quantile([0.5, 0.9]).values
        # gain of the convergence time: inf where 0.01 never converges, NaN where nothing does
        time = here["gain_convergence_time"]
        paper, ever = (100 * float(w.mean()) for w in (np.isfinite(time), time.notnull()))
        rule = {"over": "none: r > 1", "found": ""}
        if ruled.any():
            loss = here["loss_nmse"].where(ruled).quantile([0.5, 0.9]).values
            rule["over"] = f"{loss[0]:.3g} ({loss[1]:.3g})"
            rule["found"] = f"{100 * _found(here):.0f} %"
        rows.append(
            {
                "K0, N·m/rad": f"{K0:g}",
                "best sigma by nmse: median (10 to 90 %)": f"{best:.2g} ({low:.2g} to {high:.2g})",
                "by nmse_tail": f"{float(here['best_nmse_tail'].median()):.2g}",
                "nmse at 0.01 over best: median (90 %)": f"{gain[0]:.3g} ({gain[1]:.3g})",
                "converges at 0.01 / at the best": f"{paper:.0f} % / {ever:.0f} %",
                "rule of thumb over best: nmse, median (90 %)": rule["over"],
                f"rule within a factor of {FACTOR:g}": rule["found"],
            }
        )
    return pd.DataFrame(rows)


def _found(data: xr.Dataset) -> float:
    """Share of the cells with a rule whose best sigma it meets within FACTOR."""
    off = abs(np.log(data["rule"] / data["best_nmse"]))
    return float((off <= np.log(FACTOR)).where(data["rule"].notnull()).mean())


def rows(data: xr.Dataset) -> pd.DataFrame:
    """A row for each environment; `ruled`, whether the rule of thumb speaks of it."""
    table = data.to_dataframe().reset_index()
    return table.assign(ruled=table["rule"].notna(), largest=data.attrs["largest"])
