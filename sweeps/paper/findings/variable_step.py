"""The control period: where the search is too slow, where too late, and the solver's own steps.

Algorithm 2 integrates with the gain g = sigma/(period K0). The paper gives no period for its
studies of contact, which a variable-step solver ran: a recursion without one advances once
per step.
"""

import numpy as np
import pandas as pd
import xarray as xr

from fic_jax import Params, rollout
from sweeps.paper import accepted, formulas, loop
from sweeps.paper.logs import T_END

STORES = ("period-map",)
CONVERGED = 1e-4  # nmse_tail that the paper reports of the welded study (C1)
Td = 5.0  # N*m, of the store and of all runs
CASES = {  # C5, pressed on the stop from contact, then C7, the approach from 0.5 rad
    **{f"pressed, K0 = {K0:g}": Params(K0=K0) for K0 in (0.1, 1.0, 10.0, 100.0, 1000.0)},
    **{
        f"approach, Kenv = {Kenv:g}": Params(Kenv=Kenv, gap=0.5, xd=0.5)
        for Kenv in (50.0, 100.0, 500.0)
    },
}
FIXED = 0.01  # s, period and plant step of the runs beside the variable ones


def measure(periods: xr.Dataset, cases: dict[str, Params] = CASES) -> xr.Dataset:
    """The store `period-map`, what the linear loop says of it, and runs at the solver's steps."""
    mapped = periods[["nmse_tail", "status"]].load()
    K0, period = np.meshgrid(mapped["K0"], mapped["period"], indexing="ij")
    scenarios = Params(K0=K0.ravel(), period=period.ravel())
    turns, tail = loop.response(loop.starting(scenarios), T_END)
    excess, _, _ = loop.first_branch(scenarios)
    predicted = {"cycles": turns & (excess > 1.0 + 1e-6), "linear_tail": tail}
    cells = {name: (("K0", "period"), flat.reshape(K0.shape)) for name, flat in predicted.items()}
    gain = formulas.gain_for(CONVERGED, Params(), T_END)
    return mapped.assign(cells).assign(gain=gain).merge(_runs(cases), join="exact")


def _runs(cases: dict[str, Params]) -> xr.Dataset:
    """T at a fixed step and at the steps of each solver, these padded with NaN."""
    rows = [
        [accepted.accepted_steps(p, s) for s in accepted.SOLVERS.values()] for p in cases.values()
    ]
    longest = max(run.sizes["k"] for row in rows for run in row)
    padded = [[run.pad(k=(0, longest - run.sizes["k"])) for run in row] for row in rows]
    runs = xr.concat([xr.concat(row, "solver") for row in padded], "case")
    n = round(T_END / FIXED)
    fixed = [rollout(p, model=accepted.MODEL, dt=FIXED, n_steps=n).tau_env for p in cases.values()]
    return runs.assign(fixed=(("case", "sample"), np.array(fixed, float))).assign_coords(
        case=list(cases), solver=list(accepted.SOLVERS), sample=FIXED * np.arange(1, n + 1)
    )


def fixed_tail(data: xr.Dataset) -> xr.DataArray:
    """nmse_tail of the runs at the fixed step."""
    tail = data["fixed"].sel(sample=slice(T_END / 2 + FIXED / 2, None))
    return ((tail / Td - 1.0) ** 2).mean("sample")


def lines(data: xr.Dataset) -> pd.DataFrame:
    """A row for each run: the fixed step, then each solver."""
    found, fixed = [], fixed_tail(data)
    for case in data["case"].values:
        line = {"case": case, "fixed": float(fixed.sel(case=case))}
        for solver in data["solver"].values:
            run = data.sel(case=case, solver=solver)
            t, T = (run[name].dropna("k").values for name in ("t", "tau_env"))
            values = (float(run["tail"]), T[-1], len(t) - 1, np.median(np.diff(t)))
            names = (f"{solver}_{name}" for name in ("tail", "last", "steps", "step"))
            line |= dict(zip(names, values, strict=True))
        found.append(line)
    return pd.DataFrame(found)


def rows(data: xr.Dataset) -> pd.DataFrame:
    """Rows of two kinds: a `cell` of the map for each period, and a `run` at a solver's steps.

    Cells: `line` and `linear`, whether the line of constant gain and the sampled linear loop tell
    right that the tail converges; `off`, the error of the linear loop's tail.
    Runs: `near`, whether the tail is about 10^-1 with either solver; `creeps`, T below Td and
    rising; `short`, by how much its largest value is short of Td, over Td.
    """
    reached = data["nmse_tail"] <= CONVERGED
    settles = ~data["cycles"].astype(bool)
    gain = 0.01 / (data["period"] * data["K0"])
    cells = xr.Dataset(
        {
            "reached": reached,
            "settles": settles,
            "line": ((gain >= data["gain"]) & settles) == reached,
            "linear": ((data["linear_tail"] <= CONVERGED) & settles) == reached,
            "off": abs(data["linear_tail"] / data["nmse_tail"] - 1.0),
        }
    )
    fixed = fixed_tail(data).rename("fixed_tail")
    near = (abs(xr.ufuncs.log10(data["tail"] / 0.1)) < 0.5).all("solver").rename("near")
    runs = xr.merge([data[["tail", "highest", "rising"]], fixed, near]).to_dataframe().reset_index()
    runs[["study", "value"]] = runs["case"].str.split(", .* = ", regex=True, expand=True)
    return pd.concat(
        [
            cells.to_dataframe().reset_index().assign(kind="cell", gain=float(data["gain"])),
            runs.assign(
                kind="run",
                creeps=(runs["highest"] < Td) & (runs["rising"] > 0),
                short=1.0 - runs["highest"] / Td,
            ),
        ],
        ignore_index=True,
    ).assign(
        **{f"tau_{K0}": formulas.time_constant(Params(K0=K0)).item() for K0 in (10, 100, 1000)}
    )
