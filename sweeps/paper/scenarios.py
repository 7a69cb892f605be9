"""The paper's scenarios, once: rows of a table, read from the library's sweep files.

The report and the figures simulate these rows. All of it is computed in double precision (float64).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr

from fic_jax import QUANTITIES, Model, Params, histories, sweep
from sweeps import LIBRARY
from sweeps.plan.grid import Grid
from sweeps.spec.reading import load

T_END = 10.0  # s, of every simulation of the paper
STUDIES = {  # what the claims call a study -> its sweeps
    "welded": ("paper-welded",),  # fig:4 left, fig:6
    "contact": ("paper-contact",),  # fig:4 right, fig:7
    "impact": ("paper-stiffness", "paper-damping"),  # fig:5, fig:8, fig:9
}


def scenarios(*sweeps: str, **more: Sequence[float]) -> pd.DataFrame:
    """One row for each scenario of some sweeps of the library, every field of Params a column.

    The column `contact` holds the model's contact. `more` varies further fields: each row comes
    once for each combination of their values.
    """
    rows = pd.concat([_rows(name) for name in sweeps]).drop_duplicates()
    for field, values in more.items():
        rows = rows.drop(columns=field).merge(pd.DataFrame({field: list(values)}), how="cross")
    return rows.reset_index(drop=True)


def _rows(name: str) -> pd.DataFrame:
    grid = Grid(load(LIBRARY / f"{name}.toml"))
    whole = grid.block(0)
    return table(grid.params(whole)).assign(contact=grid.model(whole).contact)


def table(p: Params) -> pd.DataFrame:
    """Params as rows."""
    columns = np.broadcast_arrays(*(np.ravel(np.asarray(leaf, float)) for leaf in vars(p).values()))
    return pd.DataFrame(dict(zip(QUANTITIES, columns, strict=True)))


def params(rows: pd.DataFrame) -> Params:
    """Rows as Params with a leaf for each column."""
    return Params(**{name: rows[name].to_numpy() for name in QUANTITIES})


def measured(rows: pd.DataFrame, model: Model, dt: float) -> pd.DataFrame:
    """The rows with their metrics as further columns; `model` but for the rows' contact."""
    parts = []
    for contact, part in rows.groupby("contact", sort=False):
        chosen = replace(model, contact=contact)  # type: ignore[arg-type]
        with jax.enable_x64(True):
            metrics = sweep(params(part), model=chosen, dt=dt, n_steps=round(T_END / dt))
        parts.append(part.assign(**vars(metrics)))
    return pd.concat(parts)


def motions(rows: pd.DataFrame, model: Model, dt: float) -> xr.Dataset:
    """Time histories of rows with one contact: `fic_jax.histories`."""
    (contact,) = rows["contact"].unique()
    with jax.enable_x64(True):
        chosen: Model = replace(model, contact=contact)
        return histories(params(rows), model=chosen, dt=dt, n_steps=round(T_END / dt))


@dataclass(frozen=True)
class Reading:
    """One reading of the paper: its static choices, and how time is divided."""

    model: Model = Model()
    period: float = 0.01  # s, control period
    dt: float = 0.01  # s, plant step
    others: tuple[float, ...] = ()  # s, further periods at which a claim is tried

    def steps(self) -> Iterator[tuple[float, float]]:
        """Control periods and the plant step of each, s: the reading's own first."""
        yield self.period, self.dt
        for period in self.others:
            yield period, min(self.dt, *self.others)

    def of(self, rows: pd.DataFrame) -> pd.DataFrame:
        """The rows under this reading: a welded joint stays welded."""
        kinds = rows["contact"].where(rows["contact"] == "welded", self.model.contact)
        return rows.assign(contact=kinds)


# Plant step and control period of 10 ms, the step that the paper names.
PRINTED = Reading()


def run(rows: pd.DataFrame, reading: Reading) -> pd.DataFrame:
    """The rows with their metrics at the reading's period, then the same at each other period."""
    rows, model = reading.of(rows), reading.model
    parts = [measured(rows.assign(period=T), model, dt) for T, dt in reading.steps()]
    return pd.concat(parts, ignore_index=True)


@lru_cache(maxsize=64)
def study(name: str, reading: Reading) -> pd.DataFrame:
    """`run` for a study of the paper."""
    return run(scenarios(*STUDIES[name]), reading)


def study_motions(name: str, reading: Reading) -> Iterator[xr.Dataset]:
    """Time histories of a study, one for each row of `study`, in its order."""
    rows = reading.of(scenarios(*STUDIES[name]))
    for period, dt in reading.steps():
        together = motions(rows.assign(period=period), reading.model, dt)
        yield from (together.isel(scenario=i) for i in range(len(rows)))


def grid(**axes: Any) -> pd.DataFrame:
    """One row for each combination of the axes' values, the last axis varying fastest."""
    return pd.MultiIndex.from_product(list(axes.values()), names=list(axes)).to_frame(index=False)
