"""The motion of one cell, with the numbers that a sweep gives it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import fic_jax
from fic_jax import QUANTITIES, TRUST, Metrics, Model, Params, Sample
from fic_jax.controller import Attractor, converging_slopes
from fic_jax.lanes import lane_map, where_rare
from fic_jax.lanes.mapping import LaneMap
from fic_jax.lanes.sources import digest
from fic_jax.metrics import begin_tail, empty, finish, update
from fic_jax.passivity import lyapunov
from fic_jax.piece import rounding
from fic_jax.simulation import initial, plant_step, sampled_step, with_slopes
from sweeps.plan.grid import Block, Grid

MOST_SAMPLES = 1_000  # of a motion; a plot of it is some hundred pixels wide


@dataclass(frozen=True)
class Scenario:
    """One cell: all that its motion depends on."""

    params: Params  # scalars of the precision of the sweep
    model: Model
    dt: float
    n_steps: int

    @classmethod
    def of(cls, grid: Grid, block: Block, dtype: str) -> Self:
        """The scenario of a block of one cell."""
        params = {name: v.reshape(()) for name, v in vars(grid.params(block, dtype)).items()}
        return cls(Params(**params), grid.model(block), grid.sweep.time.dt, grid.sweep.n_steps)


@dataclass(frozen=True)
class Motion:
    """The signals of a scenario, arrays over time, and its metrics.

    The metrics are a sweep's, to the last bit. The program that returns signals has the same steps,
    but rounds a few operations in another way: a chaotic motion may differ.
    """

    scenario: Scenario
    samples: Sample
    V: NDArray[Any]  # J, the Lyapunov function
    metrics: Metrics  # scalars
    nmse: float  # of the signals

    @property
    def note(self) -> str:
        """What to say if the signals have another nmse than the cell, by more than its trust."""
        cell = float(self.metrics.nmse)
        if not abs(self.nmse - cell) > max(TRUST["nmse"].part * cell, TRUST["nmse"].floor):
            return ""
        drawn = f"the drawn motion has nmse = {self.nmse:.6g}"
        return f"The result of this cell depends on rounding: {drawn}."


def motion(scenario: Scenario) -> Motion:
    """Simulate a scenario.

    Lane k takes k plant steps, then one more whose signals it returns; the last lane takes all.
    That is quadratic in the number of steps, but 1,000 steps are the work of 500 scenarios: some
    milliseconds.
    """
    n = scenario.n_steps
    every = -(-n // MOST_SAMPLES)
    steps = np.append(np.arange(n - 1, -1, -every)[::-1], n).astype(np.int32)
    dtype = np.asarray(scenario.params.K0).dtype
    columns = [np.full(steps.size, v, dtype) for v in vars(scenario.params).values()]
    mapped = _program(scenario.model, n)
    drawn, samples, V = mapped(columns, dtype.type(scenario.dt), steps)
    one = Params(**{name: np.reshape(v, 1) for name, v in vars(scenario.params).items()})
    metrics = fic_jax.sweep(one, model=scenario.model, dt=scenario.dt, n_steps=n)
    return Motion(
        scenario,
        jax.tree.map(lambda leaf: leaf[:-1], samples),
        V[:-1],
        jax.tree.map(lambda leaf: leaf[0], metrics),
        float(drawn.nmse[-1]),
    )


@lru_cache
def _program(model: Model, n_steps: int) -> LaneMap:
    sources = [digest(Path(fic_jax.__file__).parent), digest(Path(__file__).parent)]

    def scenario(column: Sequence[jax.Array], dt: jax.Array, steps: jax.Array) -> Any:
        params = Params(**dict(zip(QUANTITIES, column, strict=True)))
        return after(params, model, dt, n_steps, steps)

    return lane_map(scenario, key=f"{sources} {model} {n_steps}" if all(sources) else None)


def after(p: Params, model: Model, dt: jax.Array, n_steps: int, steps: jax.Array) -> Any:
    """Metrics after some of the steps of a run; signals and V of the step that follows."""
    tail = n_steps // 2
    rest = rounding(p) * (dt / p.period)

    def body(carry: Any) -> Any:
        state, acc = carry
        acc = where_rare(state.k == tail, lambda: begin_tail(acc), acc)
        return plant_step(
            p, state, model, dt, lambda acc, i: update(acc, i, state.k, rest, p, model), acc
        )

    start = with_slopes(p, initial(p, model)), empty(p, model)
    state, acc = jax.lax.while_loop(lambda carry: carry[0].k < steps, body, start)
    metrics = finish(acc, state.x, state.v, n_steps, tail, p, dt)
    _, sample = sampled_step(p, state, dt, model)
    attractor = Attractor(sample.diverging, sample.e_M, converging_slopes(sample.e_M, p, model))
    V = lyapunov(sample.e, sample.v, attractor, p)
    return metrics, sample, jnp.asarray(V, sample.x.dtype)
