"""The best search resolution for each environment, against the paper's 0.01 and a rule of thumb."""

import numpy as np
import pandas as pd
import xarray as xr

from fic_jax import Params
from sweeps.paper import formulas
from sweeps.store.format import OK

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
    # without a rule the index is that of the paper's sigma; no result uses it
    position = _nearest(sigma, rule.fillna(PAPER))
    data = xr.Dataset(
        {"rule": rule}, attrs={"largest": float(sigma.max()), "smallest": float(sigma.min())}
    )
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


def rows(data: xr.Dataset) -> pd.DataFrame:
    """A row for each environment; `ruled`, whether the rule of thumb speaks of it."""
    table = data.to_dataframe().reset_index()
    return table.assign(ruled=table["rule"].notna(), largest=data.attrs["largest"])


def lines(data: xr.Dataset) -> pd.DataFrame:
    """A row for each stiffness: which sigma, and what it is worth; shares in percent."""
    found = []
    for K0, here in rows(data).groupby("K0"):
        ruled = here[here["ruled"]]
        # gain of the convergence time: inf where 0.01 never converges, NaN where nothing does
        time = here["gain_convergence_time"]
        line = {"K0": K0, "tail": here["best_nmse_tail"].median()}
        line |= {f"best_{q}": here["best_nmse"].quantile(q / 100) for q in (10, 50, 90)}
        line |= {f"gain_{q}": here["gain_nmse"].quantile(q / 100) for q in (50, 90)}
        line |= {"paper": 100 * np.isfinite(time).mean(), "ever": 100 * time.notna().mean()}
        loss = [f"{ruled['loss_nmse'].quantile(q):.3g}" for q in (0.5, 0.9)]
        off = abs(np.log(ruled["rule"] / ruled["best_nmse"]))
        line["rule"] = f"{loss[0]} ({loss[1]})" if len(ruled) else "none: r > 1"
        line["near"] = f"{100 * (off <= np.log(FACTOR)).mean():.0f} %" if len(ruled) else ""
        found.append(line)
    return pd.DataFrame(found)
