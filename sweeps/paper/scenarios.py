"""The paper's scenarios, once: rows of a table, read from the library's sweep files.

The report and the figures simulate these rows. All of it is computed in double precision (float64).
Each metric has a column, and beside it `<metric>_trusted`: whether its estimated error is within
the bound of `fic_jax.TRUST`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import jax
import numpy as np
import pandas as pd
import xarray as xr

from fic_jax import QUANTITIES, TRUST, Model, Params, histories, sweep, trusted
from sweeps import LIBRARY
from sweeps.paper import logs, simulink
from sweeps.paper.logs import T_END, Log, Mean
from sweeps.plan.grid import Grid
from sweeps.spec.reading import load

FINER = (4, 16)  # parts of the plant step that are tried where a metric is not trusted
JUDGED = (  # the metrics that claims use
    "nmse",
    "nmse_tail",
    "convergence_time",
    "steady_error",
    "overshoot",
    "contact_time",
    "contact_lost",
)
# What two equal runs may differ by: a run that this changes hangs on the last bits of its numbers.
ROUNDING = 1e-9
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
    """The rows with their metrics as further columns; `model` but for the rows' contact.

    With located switches, rows that are not trusted are simulated again at finer plant steps: a
    metric that is trusted there gets its converged value (`refined`); else it keeps its own.
    """
    parts = []
    for contact, part in rows.reset_index(drop=True).groupby("contact", sort=False):
        chosen = replace(model, contact=contact)  # type: ignore[arg-type]
        table = _evaluated(part, chosen, dt).assign(refined=False)
        for finer in FINER if model.integrator == "rk4_events" else ():
            doubted = ~table[[f"{name}_trusted" for name in JUDGED]].all(axis=1)
            if doubted.any():
                _replace_doubted(table, _evaluated(part[doubted], chosen, dt / finer))
        parts.append(table)
    return pd.concat(parts)


def _evaluated(rows: pd.DataFrame, model: Model, dt: float) -> pd.DataFrame:
    """The rows with their metrics, and whether each is trusted."""
    with jax.enable_x64(True):
        metrics, errors = sweep(
            params(rows), model=model, dt=dt, n_steps=round(T_END / dt), error_estimate=True
        )
        known = trusted(metrics, errors, T_END)
    verdicts = {f"{name}_trusted": np.asarray(getattr(known, name), bool) for name in TRUST}
    return rows.assign(**vars(metrics), **verdicts)


def _replace_doubted(table: pd.DataFrame, finer: pd.DataFrame) -> None:
    """Put values that are trusted at a finer step in the place of those that are not."""
    for name in TRUST:
        known = f"{name}_trusted"
        at = finer.index[finer[known] & ~table.loc[finer.index, known]]
        table.loc[at, [name, known]] = finer.loc[at, [name, known]]
        if name in JUDGED:
            table.loc[at, "refined"] = True


def motions(rows: pd.DataFrame, model: Model, dt: float) -> xr.Dataset:
    """Time histories of rows with one contact: `fic_jax.histories`."""
    (contact,) = rows["contact"].unique()
    with jax.enable_x64(True):
        chosen: Model = replace(model, contact=contact)
        return histories(params(rows), model=chosen, dt=dt, n_steps=round(T_END / dt))


@dataclass(frozen=True)
class Reading:
    """One reading of the paper: its static choices, how time is divided, and when the search runs.

    clock: `period`, Algorithm 2 ticks once every control period; or as in `simulink`.
    mean: of the squared errors, over time or over logged samples.
    """

    model: Model = Model()
    period: float = 0.01  # s, control period
    dt: float = 0.01  # s, plant step
    others: tuple[float, ...] = ()  # s, further periods at which a claim is tried
    clock: Literal["period"] | simulink.Clock = "period"
    rtol: float = 1e-3  # of a solver that chooses its steps: Simulink's default
    mean: Mean = "time"

    def steps(self) -> Iterator[tuple[float, float]]:
        """Control periods and the plant step of each, s: the reading's own first."""
        yield self.period, self.dt
        for period in self.others:
            yield period, min(self.dt, *self.others)

    def of(self, rows: pd.DataFrame) -> pd.DataFrame:
        """The rows under this reading: a welded joint stays welded."""
        kinds = rows["contact"].where(rows["contact"] == "welded", self.model.contact)
        return rows.assign(contact=kinds)

    @property
    def located(self) -> bool:
        """Whether its numbers are those of the motion, and not of a program's steps."""
        return self.clock == "period" and self.model.integrator == "rk4_events"

    def as_printed(self) -> "Reading":
        """The same at the reading's own period with ode4 and its smeared switches."""
        return replace(self, model=replace(self.model, integrator="rk4"), others=())


# Plant step and control period of 10 ms, the step that the paper names: what ode4 prints, and what
# the same controller does where switches are located.
PRINTED = Reading()
LOCATED = Reading(Model().with_events())


def run(rows: pd.DataFrame, reading: Reading) -> pd.DataFrame:
    """The rows with their metrics at the reading's period, then the same at each other period."""
    rows, model = reading.of(rows), reading.model
    if reading.clock == "period" and reading.mean == "time":
        parts = [measured(rows.assign(period=T), model, dt) for T, dt in reading.steps()]
    else:
        parts = [_logged(rows.assign(period=T), reading, dt) for T, dt in reading.steps()]
    return pd.concat(parts, ignore_index=True)


def _logged(rows: pd.DataFrame, reading: Reading, dt: float) -> pd.DataFrame:
    """The rows with metrics of what a program logs.

    Its steps are part of such a reading: they have no limit. A metric is trusted if a change of the
    parameters by their rounding does not move it by more than its bound.
    """
    both = pd.concat([rows, rounded(rows)], ignore_index=True)
    n, parts = len(rows), []
    for _, part in both.groupby("contact", sort=False):
        parts.append(logs.measured(log(part, reading, dt), part, reading.mean))
    table = pd.concat(parts).sort_index()
    own, twin = table[:n].set_axis(rows.index), table[n:].set_axis(rows.index)
    known = {f"{name}_trusted": _agree(name, own[name], twin[name]) for name in JUDGED}
    return own.assign(**known, refined=False)


def rounded(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with their parameters changed by their rounding."""
    return rows.assign(
        **{
            name: rows[name] * (1.0 + sign * ROUNDING)
            for name, sign in (("K0", 1), ("Fmax", -1), ("Kenv", 1), ("Denv", -1), ("I", 1))
        }
    )


def _agree(name: str, one: pd.Series, other: pd.Series) -> np.ndarray:
    """Whether two runs agree in a metric, within its bound."""
    a, b = one.to_numpy(float), other.to_numpy(float)
    bound = np.asarray(TRUST[name].error(np.where(np.isfinite(a), a, 0.0), T_END))
    with np.errstate(invalid="ignore"):
        return np.asarray((a == b) | (abs(a - b) <= bound))


def log(rows: pd.DataFrame, reading: Reading, dt: float) -> Log:
    """What is logged of rows with one contact."""
    (contact,) = rows["contact"].unique()
    if reading.clock == "period":
        return _with_starts(rows, motions(rows, reading.model, dt))
    model = replace(reading.model, contact=contact, integrator="rk4")
    return simulink.logged(params(rows), model, reading.clock, dt, reading.rtol)


def _with_starts(rows: pd.DataFrame, motion: xr.Dataset) -> Log:
    """Time histories as a log, which begins with the start: nothing touches before it moves."""
    n = len(rows)
    start = {"x": rows["x_init"], "v": rows["v_init"], "tau_env": np.zeros(n), "diverging": 0.0}
    t = np.broadcast_to(np.append(0.0, motion["time"].values), (n, motion.sizes["time"] + 1))
    columns = {
        name: np.column_stack([np.broadcast_to(first, n), motion[name].values.astype(float)])
        for name, first in start.items()
    }
    return Log(t, **columns)


@lru_cache(maxsize=64)
def study(name: str, reading: Reading) -> pd.DataFrame:
    """`run` for a study of the paper."""
    return run(scenarios(*STUDIES[name]), reading)


def study_logs(name: str, reading: Reading, dt: float) -> Iterator[tuple[Log, Log]]:
    """Logs of a study, one for each row of `study`, in its order; beside each its rounded twin.

    `dt` is the step of the samples where the reading's numbers are those of the motion.
    """
    rows = reading.of(scenarios(*STUDIES[name]))
    for period, step in reading.steps():
        here = rows.assign(period=period)
        both = pd.concat([here, rounded(here)], ignore_index=True)
        runs = log(both, reading, dt if reading.located else step).runs()
        yield from zip(runs[: len(rows)], runs[len(rows) :], strict=True)


def grid(**axes: Any) -> pd.DataFrame:
    """One row for each combination of the axes' values, the last axis varying fastest."""
    return pd.MultiIndex.from_product(list(axes.values()), names=list(axes)).to_frame(index=False)
