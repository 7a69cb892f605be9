"""The paper's scenarios, once: rows of a table, read from the library's sweep files.

The report and the figures simulate these rows. All of it is computed in double precision (float64).
Each metric has a column, and beside it, if a claim uses it, `<metric>_trusted`: whether its
error is within the bound of `fic_jax.TRUST`.
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

JUDGED = (  # the metrics that claims use
    "nmse",
    "nmse_tail",
    "convergence_time",
    "steady_error",
    "overshoot",
    "contact_time",
    "contact_lost",
)
# Twins of a run: where their parameters, changed by parts of 1e-9 of themselves, change a metric,
# it hangs on the last bits of its numbers. Each catches what the others miss.
TWINS, ROUNDING = 6, 1e-9
LOGGED_TWINS = 2  # of runs that are slower
SAMPLE = 1e-3  # s, between samples that show a motion
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

    Beside the error estimate of located switches stand TWINS runs with parameters changed by their
    rounding: a metric is trusted if they agree too. With `rk4`, whose estimate would be of what
    located switches change, the twins have half the step.
    """
    parts = []
    for contact, part in rows.reset_index(drop=True).groupby("contact", sort=False):
        chosen = replace(model, contact=contact)  # type: ignore[arg-type]
        if model.integrator == "rk4_events":
            parts.append(_estimated(part, chosen, dt))
        else:
            own, twins = _swept(part, chosen, dt), _swept(_twins(part), chosen, dt / 2)
            parts.append(own.assign(**_known(own, twins)))
    return pd.concat(parts)


def trusted_only(table: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """The table's metrics of these names, NaN where they are not trusted."""
    return table.assign(**{name: table[name].where(table[f"{name}_trusted"]) for name in names})


def _swept(rows: pd.DataFrame, model: Model, dt: float) -> pd.DataFrame:
    """The rows with their metrics."""
    with jax.enable_x64(True):
        return rows.assign(**vars(sweep(params(rows), model=model, dt=dt, n_steps=_steps(dt))))


def _estimated(rows: pd.DataFrame, model: Model, dt: float) -> pd.DataFrame:
    """The rows with their metrics, and whether estimate and twins trust each."""
    every, n = pd.concat([rows, _twins(rows)]), len(rows)
    with jax.enable_x64(True):
        metrics, errors = sweep(
            params(every), model=model, dt=dt, n_steps=_steps(dt), error_estimate=True
        )
        estimate = trusted(metrics, errors, T_END)
    table = every.assign(**vars(metrics))
    known = _known(table[:n], table[n:])
    for name in known:
        own = np.asarray(getattr(estimate, name.removesuffix("_trusted")), bool)[:n]
        known[name] = known[name] & own
    return table[:n].assign(**known)


def _steps(dt: float) -> int:
    return round(T_END / dt)


def _twins(rows: pd.DataFrame, n: int = TWINS) -> pd.DataFrame:
    """The rows `n` times, each time with their parameters changed by their rounding."""
    return pd.concat([rounded(rows, size) for size in range(1, n + 1)])


def rounded(rows: pd.DataFrame, size: int = 1) -> pd.DataFrame:
    """The rows with their parameters changed by a multiple of their rounding."""
    signs = {"K0": 1, "Fmax": -1, "Kenv": 1, "Denv": -1, "I": 1}
    return rows.assign(
        **{name: rows[name] * (1.0 + sign * size * ROUNDING) for name, sign in signs.items()}
    )


def _known(
    own: pd.DataFrame, twins: pd.DataFrame, names: Sequence[str] = JUDGED
) -> dict[str, np.ndarray]:
    """Columns `<metric>_trusted`: whether the twins agree with their row within its bound."""
    found = {}
    for name in names:
        value = own[name].to_numpy(float)
        scale = np.where(np.isfinite(value), value, 0.0)
        bound = np.asarray(TRUST[name.removesuffix("_of_samples")].error(scale, T_END))
        others = twins[name].to_numpy(float).reshape(-1, len(own))
        with np.errstate(invalid="ignore"):
            found[f"{name}_trusted"] = ((others == value) | (abs(others - value) <= bound)).all(0)
    return found


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

    def simplest(self, rows: pd.DataFrame) -> "Reading":
        """The reading without choices that make no difference to these rows.

        With xd = 0 either x~ has the same size; a welded joint has no other contact.
        """
        model = self.model
        if (rows["xd"] == 0.0).all():
            model = replace(model, expectation="displacement")
        if (rows["contact"] == "welded").all():
            model = replace(model, contact="hard_stop")
        return replace(self, model=model)

    @property
    def located(self) -> bool:
        """Whether switches are located."""
        return self.clock == "period" and self.model.integrator == "rk4_events"

    @property
    def resolved(self) -> bool:
        """Whether its numbers are those of the motion, and not of a program's steps."""
        return self.located or (self.clock == "period" and self.dt <= SAMPLE)

    def as_printed(self) -> "Reading":
        """The same at the reading's own period with ode4 and its smeared switches."""
        return replace(self, model=replace(self.model, integrator="rk4"), others=())


# Plant step and control period of 10 ms, the step that the paper names: what ode4 prints, and what
# the same controller does where switches are located.
PRINTED = Reading()
LOCATED = Reading(Model().with_events())


def run(rows: pd.DataFrame, reading: Reading) -> pd.DataFrame:
    """The rows with their metrics at the reading's period, then the same at each other period."""
    rows, reading = reading.of(rows), reading.simplest(rows)
    model = reading.model
    if reading.clock == "period":
        parts = [measured(rows.assign(period=T), model, dt) for T, dt in reading.steps()]
    else:
        parts = [_logged(rows.assign(period=T), reading, dt) for T, dt in reading.steps()]
    return pd.concat(parts, ignore_index=True)


def _logged(rows: pd.DataFrame, reading: Reading, dt: float) -> pd.DataFrame:
    """The rows with metrics of what a program logs.

    Its steps are part of such a reading: they have no limit. The twins have the same.
    """
    twins, n, parts = _twins(rows, LOGGED_TWINS), len(rows), []
    every = pd.concat([rows, twins], ignore_index=True)
    for _, part in every.groupby("contact", sort=False):
        parts.append(logs.measured(log(part, reading, dt), part))
    table = pd.concat(parts).sort_index()
    known = _known(table[:n], table[n:], (*JUDGED, *(f"{name}_of_samples" for name in logs.MEANS)))
    return with_mean(table[:n].assign(**known), reading.mean)


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
    still = np.zeros(n)
    starts = {"x": rows["x_init"], "v": rows["v_init"], "tau_env": still, "diverging": still}
    t = np.broadcast_to(np.append(0.0, motion["time"].values), (n, motion.sizes["time"] + 1))
    columns = {
        name: np.column_stack([np.asarray(first, float), motion[name].values.astype(float)])
        for name, first in starts.items()
    }
    return Log(t, **columns)


def study(name: str, reading: Reading) -> pd.DataFrame:
    """`run` for a study of the paper."""
    simplest = reading.simplest(scenarios(*STUDIES[name]))
    if simplest.mean == "samples":
        return with_mean(_study(name, replace(simplest, mean="time")), "samples")
    return _study(name, simplest)


@lru_cache(maxsize=256)
def _study(name: str, reading: Reading) -> pd.DataFrame:
    return run(scenarios(*STUDIES[name]), reading)


def with_mean(table: pd.DataFrame, mean: Mean) -> pd.DataFrame:
    """A table of logged runs with this mean under the metrics' own names."""
    if mean == "time":
        return table
    names = {
        f"{name}{of}": f"{name}_of_samples{of}" for name in logs.MEANS for of in ("", "_trusted")
    }
    return table.assign(**{name: table[logged] for name, logged in names.items()})


def study_logs(name: str, reading: Reading) -> Iterator[tuple[Log, Log]]:
    """Logs of a study, one for each row of `study`, in its order; beside each its rounded twin."""
    rows = reading.of(scenarios(*STUDIES[name]))
    for period, step in reading.steps():
        here = rows.assign(period=period)
        both = pd.concat([here, rounded(here)], ignore_index=True)
        runs = log(both, reading, min(step, SAMPLE) if reading.located else step).runs()
        yield from zip(runs[: len(rows)], runs[len(rows) :], strict=True)


def grid(**axes: Any) -> pd.DataFrame:
    """One row for each combination of the axes' values, the last axis varying fastest."""
    return pd.MultiIndex.from_product(list(axes.values()), names=list(axes)).to_frame(index=False)
