"""The paper's simulations as labelled grids: metrics or histories over any fields of Params."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
import xarray as xr

from fic_jax import METRICS, QUANTITIES, Model, Params, rollout, sweep

PAPER = Params()
T_END = 10.0  # s, of every simulation of the paper
PRINTED_STEP = 0.01  # s, the paper's ode4 step; Algorithm 2 ticks at each
# s, by the ending of a picture's name: every study is drawn at the step the paper prints, and at
# one where Algorithm 2, an integrator of gain sigma/(period K0), is ten times as quick.
STEPS = {"": PRINTED_STEP, "_1ms": 0.001}
STIFFNESSES = (0.1, 1.0, 10.0, 100.0, 1000.0)  # N*m/rad, K0: text and captions together
ENVIRONMENTS = {"Kenv": (50.0, 100.0, 500.0), "Denv": (0.0, 63.2, 189.7)}  # of the approach
GAP = 0.5  # rad, where the environment of the approach begins
ESTIMATE_ERROR = 0.001  # rad, the "1 % error" of fig:4: one hundredth of x0

Grid = Mapping[str, Sequence[float]]


def metrics(
    grid: Grid, *, model: Model = Model(), step: float = PRINTED_STEP, **constants: float
) -> xr.Dataset:
    """nmse and nmse_tail over the product of a grid's fields, in float64.

    `step` (s) is plant step and control period alike.
    """
    with jax.enable_x64(True):
        batch = Params(**_columns(grid), **constants, period=step)
        computed = sweep(batch, model=model, dt=step, n_steps=round(T_END / step))
    shape = tuple(len(values) for values in grid.values())
    names = ("nmse", "nmse_tail")
    told = {n: (tuple(grid), np.reshape(getattr(computed, n), shape), _attrs(n)) for n in names}
    return xr.Dataset(told, _coordinates(grid), constants | {"period": step})


def histories(
    grid: Grid, *, model: Model = Model(), step: float = PRINTED_STEP, **constants: float
) -> xr.Dataset:
    """Interaction torque (N*m) and position (rad) over a grid's fields and time, in float64."""
    n_steps = round(T_END / step)

    def one(columns: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        p = Params(**columns, **constants, period=step)
        motion = rollout(p, model=model, dt=step, n_steps=n_steps)
        return motion.tau_env, motion.x

    with jax.enable_x64(True):
        runs = [np.asarray(a) for a in jax.jit(jax.vmap(one))(_columns(grid))]
    shape = (*(len(values) for values in grid.values()), n_steps)
    dims = (*grid, "t")
    torque, x = ((dims, run.reshape(shape)) for run in runs)
    coordinates = _coordinates(grid) | {"t": step * np.arange(1, n_steps + 1)}
    return xr.Dataset({"torque": torque, "x": x}, coordinates, constants | {"period": step})


def told_step(data: xr.Dataset) -> str:
    """The time step of a study, for its title."""
    return f"plant step and control period {1000 * data.attrs['period']:g} ms"


def _columns(grid: Grid) -> dict[str, np.ndarray]:
    mesh = np.meshgrid(*grid.values(), indexing="ij")
    return {name: axis.ravel().astype(float) for name, axis in zip(grid, mesh, strict=True)}


def _coordinates(grid: Grid) -> dict[str, tuple[str, np.ndarray, dict[str, str]]]:
    return {
        name: (name, np.array(values, float), {"units": QUANTITIES[name]["unit"]})
        for name, values in grid.items()
    }


def _attrs(metric: str) -> dict[str, str]:
    return {"long_name": METRICS[metric]["meaning"], "units": METRICS[metric]["unit"]}
