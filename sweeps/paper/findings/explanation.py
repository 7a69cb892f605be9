"""Which single reading explains most of the paper, and what is left."""

from functools import lru_cache

import numpy as np
import pandas as pd
import xarray as xr
from scipy.integrate import OdeSolver

from fic_jax import Model, Params
from sweeps.paper import accepted
from sweeps.paper.claims import CLAIMS, impact
from sweeps.paper.findings import readings
from sweeps.paper.logs import average
from sweeps.paper.scenarios import LOCATED, Reading, motions, scenarios, study
from sweeps.paper.words import read

STORES = ()
STIFFNESSES = (50.0, 100.0, 200.0)  # N*m/rad, K0 of an approach with x~ as the error
Td = 5.0  # N*m, of it
ERROR = Reading(Model(expectation="error").with_events())
STAGES = Reading(clock="stages")
PARTS = tuple(part.id for part in readings.PARTS)


def measure() -> xr.Dataset:
    """The data of `readings`, and numbers about each way in which the paper may have been run."""
    return readings.measure().assign_attrs(_numbers())


@lru_cache
def _numbers() -> dict[str, float]:
    """Numbers of single readings; torques in N*m."""
    found: dict[str, float] = {}
    far = scenarios("paper-stiffness", K0=STIFFNESSES).query("Kenv == 100")
    T = motions(far, ERROR.model, LOCATED.dt)["tau_env"].isel(time=-1).values
    found |= {f"T_{K0:g}": float(last) for K0, last in zip(STIFFNESSES, T, strict=True)}
    seen = impact.observed(ERROR)
    found["below"] = float((seen["highest"] < 0).sum())
    welded = study("welded", STAGES).query("K0 >= 1 and Td <= Fmax")
    found["stages_nmse"] = float(welded["nmse"].max())
    worst = welded.iloc[int(welded["nmse"].argmax())]
    found |= {"stages_K0": float(worst["K0"]), "stages_Td": float(worst["Td"])}
    stiff = welded.query("K0 == 1000")
    found |= {"stages_1000": float(stiff["nmse"].max())}
    found |= {"stages_tail": float(stiff["nmse_tail"].max())}
    for name, solver in accepted.SOLVERS.items():
        means = np.array([_means(p, solver) for p in APPROACHES])
        for mean, column in zip(("time", "samples"), means.T, strict=True):
            found |= {f"{name}_{mean}_from": column.min(), f"{name}_{mean}_to": column.max()}
    return found


APPROACHES = tuple(Params(Kenv=Kenv, gap=0.5, xd=0.5) for Kenv in (50.0, 100.0, 500.0))


def _means(p: Params, solver: type[OdeSolver]) -> tuple[float, float]:
    """nmse as a mean over time, and over logged steps."""
    run = accepted.accepted_steps(p, solver)
    t, square = run["t"].values, (run["tau_env"].values / Td - 1.0) ** 2
    return average(t, square, 0.0, "time"), average(t, square, 0.0, "samples")


def lines(data: xr.Dataset) -> pd.DataFrame:
    """A row for each claim and part: as printed, under the best reading, and at best."""
    best, found = _best(data), []
    for id in data["claim"].values:
        cell = data.sel(claim=id)
        most = cell["score"].argmax("reading")
        found.append(
            {
                "claim": f"{id}: {TITLES[str(id)]}",
                "printed": _mark(cell.sel(reading=readings.name(readings.DEFAULT))),
                "best": _mark(cell.sel(reading=best)),
                "most": _mark(cell.isel(reading=int(most))),
                "reading": str(cell["reading"].values[int(most)]),
            }
        )
    return pd.DataFrame(found)


def _titles() -> dict[str, str]:
    titles = {claim.id: str(read(f"claims/{claim.id}").head["title"]) for claim in CLAIMS}
    return titles | {
        "C1 run": "nmse of the whole run, K0 ≥ 1 and Td ≤ Fmax",
        "C1 tail": "nmse of the last 5 s, the same",
        "C5 tail": "an error of 10⁻¹ alone, Td ≤ Fmax",
    }


TITLES = _titles()


def _best(data: xr.Dataset) -> str:
    return str(readings.ranking(data)["reading"].iloc[0])


def _mark(cell: xr.Dataset) -> str:
    return f"{readings.SIGNS[int(cell['verdict'])]} {100 * float(cell['score']):.0f}"


def rows(data: xr.Dataset) -> pd.DataFrame:
    """One row: the best reading, what it explains and what it does not, and the numbers."""
    alone, best = readings.claims_alone(data), _best(data)
    ranked = readings.ranking(data)
    own = ranked[ranked["default"]].iloc[0]
    both = ranked["setting"].str.contains(readings.BOTH)
    plain, like_best = ranked[~both].iloc[0], ranked[both]["fit"]
    verdict = alone["verdict"].sel(reading=best)
    share = {
        f"share_{part.replace(' ', '_')}": 100 * float(data["score"].sel(reading=best, claim=part))
        for part in PARTS
    }
    texts = {
        "best": best,
        "fit": ranked["fit"].iloc[0],
        "own_fit": own["fit"],
        "plain": plain["reading"],
        "plain_fit": plain["fit"],
        "count": len(ranked),
        "both_count": len(like_best),
        "both_least": like_best.min(),
        "both_median": like_best.median(),
        "holding": _ids(alone, verdict == 2),
        "partly": _ids(alone, verdict == 1),
        "open": _ids(alone, verdict == 0),
        "never": _ids(alone, alone["verdict"].max("reading") < 2),
        "alone": _ids(alone, alone["verdict"].max("reading") == 0),
    }
    return pd.DataFrame([texts | share | dict(data.attrs)])


def _ids(data: xr.Dataset, chosen: xr.DataArray) -> str:
    return ", ".join(str(id) for id in data["claim"].values[chosen.values]) or "none"
