"""The paper's studies, run under a reading: scenarios and their metrics, each run once."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from fic_jax import Metrics, Model, Params, Sample, rollout, sweep
from sweeps.paper.record import Condition, Reading

T_END = 10.0  # s, all the paper's simulations
WELDED_K0 = (0.1, 1.0, 10.0, 100.0, 1000.0)  # the text's values and the captions' K0 = 1
TORQUES = (1.0, 5.0, 10.0, 20.0)
STIFFNESSES = (50.0, 100.0, 500.0)  # of the environment, at Denv = 189.7
DAMPINGS = (0.0, 63.2, 189.7)  # of the environment, at Kenv = 100


@dataclass(frozen=True)
class Study:
    """Scenarios at the reading's period, then the same at each of the other periods."""

    params: dict[str, np.ndarray]  # field -> [N]
    printed: np.ndarray  # [N] bool: at the reading's own period
    metrics: Metrics  # [N]

    def column(self, name: str) -> np.ndarray:
        """[N] values of a field, the paper's where the study does not set it."""
        default = np.full(len(self.printed), getattr(Params(), name))
        return self.params.get(name, default)

    def at_least_period(self) -> np.ndarray:
        """[N] bool: at the shortest period run."""
        period = self.params["period"]
        return np.asarray(period == period.min())

    def only(self, of: Callable[[dict[str, np.ndarray]], np.ndarray]) -> "Study":
        """The scenarios whose fields satisfy `of`."""
        kept = of(self.params)
        fields = {name: column[kept] for name, column in self.params.items()}
        metrics = jax.tree.map(lambda leaf: leaf[kept], self.metrics)
        return Study(fields, self.printed[kept], metrics)

    def names(self, *fields: str) -> list[str]:
        """Scenarios named by these fields; the period is named where it differs."""
        return [
            ", ".join(
                _named(name, self.params[name][i])
                for name in (*fields, *(() if self.printed[i] else ("period",)))
            )
            for i in range(len(self.printed))
        ]

    def conditions(self, parts: dict[str, np.ndarray]) -> list[Condition]:
        """`parts` (words -> [N] bool) at the reading's period, then at each other period."""
        found = [Condition(words, where & self.printed) for words, where in parts.items()]
        period = self.params["period"]
        for other in dict.fromkeys(period[~self.printed]):
            at = ~self.printed & (period == other)
            for words, where in parts.items():
                both = " and ".join(
                    part for part in (f"period = {1e3 * other:g} ms", words) if part
                )
                found.append(Condition(both, where & at))
        return found


def _named(name: str, value: float) -> str:
    return f"period = {1e3 * value:g} ms" if name == "period" else f"{name} = {value:g}"


def _grid(**axes: tuple[float, ...]) -> dict[str, np.ndarray]:
    columns = np.meshgrid(*axes.values(), indexing="ij")
    return {name: column.ravel() for name, column in zip(axes, columns, strict=True)}


def run(columns: dict[str, np.ndarray], reading: Reading, contact: str | None) -> Study:
    """Metrics of scenarios under a reading, at its own period and at the others it names.

    A welded study welds any reading; a study of contact keeps what the reading says of contact.
    """
    model = with_contact(reading.model, contact)
    n = len(next(iter(columns.values())))
    parts = []
    for period, dt in steps(reading):
        fields = columns | {"period": np.full(n, period)}
        metrics_of = reading.runner.metrics if reading.runner else sweep_of
        parts.append((fields, metrics_of(fields, model, dt)))
    joined = {name: np.concatenate([p[0][name] for p in parts]) for name in parts[0][0]}
    metrics = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(p[1] for p in parts))
    return Study(joined, np.arange(n * len(parts)) < n, metrics)


def with_contact(model: Model, contact: str | None) -> Model:
    """The reading's model, welded or not; `contact` None: the reading's own kind of stop."""
    if contact is None:
        contact = "hard_stop" if model.contact == "welded" else model.contact
    return replace(model, contact=contact)  # type: ignore[arg-type]


def steps(reading: Reading) -> list[tuple[float, float]]:
    """Control periods to run and the plant step of each, s: the reading's first."""
    fine = min((reading.dt, *reading.others))
    return [(reading.period, reading.dt), *((period, fine) for period in reading.others)]


def sweep_of(fields: dict[str, np.ndarray], model: Model, dt: float) -> Metrics:
    """Metrics of scenarios given by their fields."""
    return sweep(Params(**fields), model=model, dt=dt, n_steps=round(T_END / dt))


@lru_cache(maxsize=64)
def welded(reading: Reading) -> Study:
    """K0 by Td, welded to Kenv = 100, Denv = 189.7 (fig:4 left, fig:6)."""
    return run(_grid(K0=WELDED_K0, Td=TORQUES), reading, "welded")


@lru_cache(maxsize=64)
def contact(reading: Reading) -> Study:
    """The same against a hard stop, from contact (fig:4 right, fig:7)."""
    return run(_grid(K0=WELDED_K0, Td=TORQUES), reading, None)


def impact_columns() -> dict[str, np.ndarray]:
    """The approach from 0.5 rad: three stiffnesses, then the two other dampings."""
    Kenv = [*STIFFNESSES, *(100.0 for _ in DAMPINGS[:2])]
    Denv = [*(189.7 for _ in STIFFNESSES), *DAMPINGS[:2]]
    half = np.full(len(Kenv), 0.5)
    return {"Kenv": np.array(Kenv), "Denv": np.array(Denv), "gap": half, "xd": half}


@lru_cache(maxsize=64)
def impact(reading: Reading) -> Study:
    """The approach from 0.5 rad to five environments (fig:5, fig:8, fig:9)."""
    return run(impact_columns(), reading, None)


@lru_cache(maxsize=64)
def impact_motions(reading: Reading) -> tuple[Sample, ...]:
    """Time histories of `impact`, one for each scenario, in its order."""
    model = with_contact(reading.model, None)
    columns = impact_columns()
    motions: list[Sample] = []
    for period, dt in steps(reading):
        fields = columns | {"period": np.full(len(columns["gap"]), period)}
        histories_of = reading.runner.histories if reading.runner else rollouts
        together = histories_of(fields, model, dt)
        for i in range(len(columns["gap"])):
            motions.append(jax.tree.map(lambda leaf, i=i: leaf[i], together))
    return tuple(motions)


def rollouts(fields: dict[str, np.ndarray], model: Model, dt: float) -> Sample:
    """Time histories of scenarios given by their fields, leaves [N, steps]."""
    together = _histories(model, dt, round(T_END / dt))(_params(fields))
    return jax.tree.map(np.asarray, together)


def _params(fields: dict[str, np.ndarray]) -> Params:
    n = len(next(iter(fields.values())))
    every = {name: np.full(n, value) for name, value in vars(Params()).items()}
    return Params(**(every | fields))


@lru_cache(maxsize=64)
def _histories(model: Model, dt: float, n_steps: int) -> Callable[[Params], Any]:
    return jax.jit(jax.vmap(lambda p: rollout(p, model=model, dt=dt, n_steps=n_steps)))
