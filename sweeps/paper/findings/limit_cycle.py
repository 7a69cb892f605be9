"""Where the loop never settles, and the boundary of that region from the loop's own formula."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from fic_jax import Metrics, Model, Params, sweep, trusted
from sweeps.paper import formulas, loop
from sweeps.paper.scenarios import grid

STORES = ()
DT = 1e-3  # s; finer than the printed 10 ms, so that the plant's integration is not the matter
T_END = 20.0  # s; the tail is what is left after the paper's 10 s
N_STEPS = round(T_END / DT)
SWING = 1e-2  # root mean square of T about its mean, over T_n, that counts as a limit cycle
LASTING = 0.25  # of its swing over 5 to 10 s that must last: what fades is none
SWITCHES = 10  # of Algorithm 1 after 10 s, at least: a slow approach has none
STRIPE = np.arange(25.0, 50.0, 0.25)  # N*m/rad, about the stripe
WORSE = 100.0  # times the nmse_tail of `effort`: there is the stripe

READINGS = {
    "algorithm1, welded": Model(contact="welded"),
    "algorithm1, hard stop": Model(),
    "effort, welded": Model(law="effort", contact="welded"),
}
K0 = np.geomspace(1.0, 1000.0, 37)
PERIODS = 1e-3 * np.array([1, 2, 3, 5, 7, 10, 14, 20, 25, 32, 40, 50, 63, 79, 100, 126, 158, 200])
SIGMAS = np.geomspace(1e-4, 1.0, len(PERIODS))


class Map(NamedTuple):
    """Scenarios over K0 and one other field, all else the paper's but for `Denv`."""

    field: str
    values: np.ndarray
    Denv: float


MAPS = {
    "period": Map("period", PERIODS, 189.7),
    "sigma": Map("sigma", SIGMAS, 189.7),
    "period, light damping": Map("period", PERIODS, 20.0),
}


def batch(K0: np.ndarray, *maps: Map) -> Params:
    """Every cell of some maps, flat, K0 along the first side; in single precision."""
    cells = [grid(K0=K0, **{m.field: m.values}).assign(Denv=m.Denv) for m in maps]
    columns = pd.concat(cells).fillna(vars(Params())).astype(np.float32)
    return Params(**{str(name): column.to_numpy() for name, column in columns.items()})


def measure(
    K0: np.ndarray = K0,
    maps: dict[str, Map] = MAPS,
    readings: dict[str, Model] = READINGS,
    stripe_K0: np.ndarray = STRIPE,
) -> xr.Dataset:
    """Limit cycles measured and predicted on each map, and the stripe of Algorithm 1."""
    every = batch(K0, *maps.values())
    over = ("map", "K0", "step")
    shape = (len(maps), len(K0), -1)
    observed = [_observed(every, model) for model in readings.values()]
    found = {
        name: (("reading", *over), np.stack([each[name].reshape(shape) for each in observed]))
        for name in observed[0]
    }
    predicted = {name: (over, cells.reshape(shape)) for name, cells in predictions(every).items()}
    first = _trusted(batch(K0, next(iter(maps.values())))).reshape(len(K0), -1)
    sides = {
        "value": (("map", "step"), np.stack([m.values for m in maps.values()])),
        "field": ("map", [m.field for m in maps.values()]),
        "Denv": ("map", [m.Denv for m in maps.values()]),
    }
    names = {"reading": list(readings), "map": list(maps), "K0": K0}
    extra = {"trusted": (("K0", "step"), first), **_stripe(stripe_K0)}
    return xr.Dataset({**found, **predicted, **extra}, coords=names | sides)


def _trusted(cells: Params) -> np.ndarray:
    """Whether the first reading's numbers can be trusted."""
    model = next(iter(READINGS.values()))
    metrics, errors = sweep(cells, model=model, dt=DT, n_steps=N_STEPS, error_estimate=True)
    return np.asarray(trusted(metrics, errors, T_END).nmse)


def _observed(cells: Params, model: Model) -> dict[str, np.ndarray]:
    """By what the joint does, no formula: does T keep swinging, did the joint turn at all."""
    whole = sweep(cells, model=model, dt=DT, n_steps=N_STEPS)
    half = sweep(cells, model=model, dt=DT / 2, n_steps=N_STEPS)  # the same program, for 10 s
    swing, late = _swing(whole), whole.mode_switches - half.mode_switches
    lasts = (swing > SWING) & (swing > LASTING * _swing(half)) & (late >= SWITCHES)
    # one switch comes with setting off: a turn is another
    return {"cycles": lasts, "turned": whole.mode_switches > 1}


def _swing(metrics: Metrics) -> np.ndarray:
    """Root mean square of T about its mean over the tail, over T_n."""
    return np.asarray(np.sqrt(np.maximum(metrics.nmse_tail - metrics.steady_error**2, 0.0)))


def predictions(p: Params) -> dict[str, np.ndarray]:
    """What the formulas say of each scenario.

    `closed`: K0 below `formulas.overshoot_stiffness`. `linear`: the sampled linear loop turns, and
    the joint started with more than Td. `unstable`: one of the loop's branches at rest is.
    """
    excess, _, _ = loop.first_branch(p)
    turns, _ = loop.response(loop.starting(p), T_END)
    radius = [loop.resting(p, branch).spectral_radius() for branch in ("diverging", "converging")]
    return {
        "closed": formulas.overshoot_stiffness(p) > p.K0,
        "turns": turns,
        "linear": turns & (excess > 1.0 + 1e-6),
        "unstable": np.maximum(*radius) > 1.0,
    }


def _stripe(K0: np.ndarray) -> dict[str, Any]:
    """nmse_tail along K0 at the printed period, for the law as printed and for `effort`."""
    models = Model(contact="welded"), Model(law="effort", contact="welded")
    along = Params(K0=K0.astype(np.float32))
    runs = [sweep(along, model=model, dt=DT, n_steps=N_STEPS) for model in models]
    return {
        "stripe_K0": ("along", K0),
        "stripe_tail": (("law", "along"), np.stack([run.nmse_tail for run in runs]).astype(float)),
        "stripe_ends": ("end", np.array(formulas.stripe(Params()))),
        "law": ("law", [model.law for model in models]),
    }


def outstanding(data: xr.Dataset) -> np.ndarray:
    """K0 of the stripe: where the printed law is worse than `effort` by more than WORSE."""
    printed, effort = data["stripe_tail"].values
    return np.asarray(data["stripe_K0"].values[printed > WORSE * effort])


def rows(data: xr.Dataset) -> pd.DataFrame:
    """A row for each cell of each map, with what was measured and predicted, and the stripe."""
    stripe, (low, high) = outstanding(data), data["stripe_ends"].values
    cells = data.drop_dims(["along", "law", "end"]).to_dataframe().reset_index()
    return cells.assign(
        stripe_from=stripe.min(), stripe_to=stripe.max(), rest_from=low, rest_to=high
    )


def lines(data: xr.Dataset) -> pd.DataFrame:
    """How well the formulas tell, in percent of the cells, a row for each reading and map.

    Of the formulas `closed` and `linear`: `..._right`, predicted but not measured (`..._false`),
    measured but not predicted (`..._missed`).
    """
    cells = rows(data)
    for name in ("closed", "linear"):
        cells[f"{name}_right"] = cells[name] == cells["cycles"]
        cells[f"{name}_false"] = cells[name] & ~cells["cycles"]
        cells[f"{name}_missed"] = ~cells[name] & cells["cycles"]
    groups = cells.groupby(["reading", "map"], sort=False)
    return (100 * groups.mean(numeric_only=True)).reset_index()
