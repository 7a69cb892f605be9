"""`histories`: the signals of N scenarios over time, labelled."""

import dataclasses
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from fic_jax.engine.sweeping import at_once, checked_fields, columns, length
from fic_jax.inputs import ParamsError, count, on_host, transferred
from fic_jax.params import QUANTITIES, Model, Params
from fic_jax.simulation import (
    SIGNALS,
    Sample,
    State,
    initial,
    sampled_step,
    stacked,
    with_slopes,
)

if TYPE_CHECKING:
    import xarray as xr


def histories(
    batch: Params, *, model: Model = Model(), dt: float, n_steps: int, every: int = 1
) -> "xr.Dataset":
    """Simulate N scenarios over `n_steps` plant steps of `dt` seconds and return their signals.

    Takes Params with [N] leaves (scalars broadcast). Returns an xarray.Dataset with dimensions
    (scenario, time): the signals of `Sample` with their units, at the end of every `every`-th plant
    step. `work` is the work since the last sample. Coordinates are `time` (s) and the fields of
    Params, along `scenario` where they vary. Floats have the dtype of the leaves. A sample of one
    scenario takes 33 bytes in float32 and 65 in float64; `sweep` stores no samples.

    Raises ParamsError if a value is out of bounds, if leaves have different lengths, or if `every`
    does not divide `n_steps`.
    """
    import xarray as xr  # half a second with pandas, and a sweep needs neither

    every = count("every", every)
    fields, h, n_steps = checked_fields(batch, model, dt, n_steps, instead="rollout")
    if n_steps % every:
        raise ParamsError("every", every, f"a divisor of n_steps = {n_steps}")
    params, shape = Params(*columns(fields)), {"n_samples": n_steps // every, "every": every}
    with at_once():
        samples = on_host(transferred(_sampled, params, h, model=model, **shape))
    signals = {
        name: (("scenario", "time"), getattr(samples, name), _labels(about))
        for name, about in SIGNALS.items()
        if name != "t"
    }
    steps = np.arange(every, n_steps + 1, every, dtype=h.dtype)
    time = ("time", steps * h, _labels(SIGNALS["t"]))
    n = length(fields)
    coordinates = {
        name: ("scenario", c) if c.size == n != 1 else ((), c.reshape(()))
        for name, c in fields.items()
    }
    coordinates = {k: (*c, _labels(QUANTITIES[k])) for k, c in coordinates.items()}
    return xr.Dataset(
        signals, {"time": time} | coordinates, {"dt": float(dt), **dataclasses.asdict(model)}
    )


def _labels(about: Any) -> dict[str, str]:
    return {"units": about["unit"], "long_name": about["meaning"]}


@partial(jax.jit, static_argnames=("model", "n_samples", "every"))
def _sampled(params: Params, dt: jax.Array, model: Model, n_samples: int, every: int) -> Sample:
    """Samples with leaves [scenario, time]."""

    def one(p: Params) -> Sample:
        start = with_slopes(p, initial(p, model))
        return stacked(lambda state: _after(p, state, model, dt, every), start, n_samples)

    return jax.vmap(one)(params)


def _after(
    p: Params, state: State, model: Model, dt: jax.Array, steps: int
) -> tuple[State, Sample]:
    """The state after some plant steps, and the last one's sample, with the work of all."""

    def body(_: jax.Array, carry: tuple[State, Sample]) -> tuple[State, Sample]:
        state, sample = sampled_step(p, carry[0], dt, model)
        return state, dataclasses.replace(sample, work=carry[1].work + sample.work)

    first = sampled_step(p, state, dt, model)
    if steps == 1:
        return first
    after: tuple[State, Sample] = jax.lax.fori_loop(1, steps, body, first)
    return after
