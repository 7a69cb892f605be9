"""What a sweep has to keep to beyond the types of its keys: a line for each thing wrong."""

import math
from collections.abc import Iterator
from typing import Any, cast

import numpy as np

from fic_jax import CHOICES, QUANTITIES, Model, Params, ParamsError
from fic_jax.params import check, check_field
from sweeps.plan.grid import dims_of
from sweeps.spec.types import (
    MAX_AXIS,
    MAX_CELLS,
    MAX_PERIODS,
    MAX_STEPS,
    STORED,
    Spacing,
    Sweep,
    suggest,
)
from sweeps.spec.wording import beginning, one_of


def unknown_names(sweep: Sweep) -> Iterator[str]:
    """Fields, choices and metrics that there are none of, or that are given twice."""
    for section, fields in sweep.given().items():
        for name in fields:
            if name not in QUANTITIES:
                hint = suggest(name, list(QUANTITIES)) or one_of(list(QUANTITIES))
                yield f"unknown key `{section}.{name}`{hint}"
    for name, chosen in sweep.model.items():
        if name not in CHOICES:
            hint = suggest(name, list(CHOICES)) or one_of(list(CHOICES))
            yield f"unknown key `model.{name}`{hint}"
            continue
        options = chosen if isinstance(chosen, list) else [chosen]
        if len(set(options)) < len(options):
            yield f"`model.{name}` must be choices that differ, but is {options}."
        for option in options:
            try:
                Model(**cast(Any, {name: option}))
            except ParamsError as error:
                yield f"`model.{name}` must be {error.wanted}, but is {error.value}."
    for name in sweep.metrics:
        if name not in STORED:
            yield f"unknown metric `{name}`{suggest(name, STORED) or one_of(list(STORED))}"
    if len(set(sweep.metrics)) < len(sweep.metrics):
        yield f"`metrics` must be different from each other, but is {sweep.metrics}."


def placement(sweep: Sweep) -> Iterator[str]:
    """Each field has one place; axes and a sample exclude each other; cases are equally long."""
    if sweep.sample and sweep.axes:
        yield "`sample` must be given instead of `axes`, but both are there."
    places: dict[str, str] = {}
    for section, fields in sweep.given().items():
        for name in fields:
            if name in places:
                yield f"`{section}.{name}` must be given once, but is in `{places[name]}` too."
            places[name] = section
    lengths = {name: len(values) for name, values in sweep.cases.items()}
    if len(set(lengths.values())) > 1:
        yield f"`cases` must be columns of equal length, but are {lengths}."
    for name in sweep.axes:
        axis = sweep.axes[name]
        if not (axis.distinct if isinstance(axis, Spacing) else len(set(axis)) == len(axis)):
            yield f"`axes.{name}` must be values that differ, but some are given twice."
    lists = any(isinstance(chosen, list) for chosen in sweep.model.values())
    if not (sweep.axes or sweep.cases or sweep.sample or lists):
        yield "`axes` must name at least one quantity to sweep, but is empty."
    if sweep.sample and "period" in sweep.sample.ranges:
        yield "`sample.ranges.period` must be an axis or a case: it is a multiple of dt."
    yield from _sizes(sweep)


def _sizes(sweep: Sweep) -> Iterator[str]:
    """What is too much to plan or to hold."""
    cells, sample, period = (
        math.prod(dims_of(sweep).values()),
        sweep.sample,
        sweep.axes.get("period"),
    )
    if cells > MAX_CELLS:
        yield f"the sweep must have at most {MAX_CELLS:,} scenarios, but has {beginning(cells)}."
    if sample and sample.method == "lhs" and sample.n * len(sample.ranges) > MAX_AXIS:
        most = MAX_AXIS // len(sample.ranges)
        yield f"`sample.n` must be at most {most:,} with lhs, but is {sample.n}."
    if isinstance(period, Spacing) and period.n > MAX_PERIODS:
        yield f"`axes.period.n` must be at most {MAX_PERIODS:,}, but is {period.n}."


def time_grid(sweep: Sweep) -> Iterator[str]:
    """Whether t_end is a whole number of steps, and not too many."""
    dt, t_end = sweep.time.dt, sweep.time.t_end
    steps = t_end / dt if dt * MAX_STEPS > t_end / 2 else np.inf  # a tiny dt would overflow
    if steps > MAX_STEPS:
        yield f"`time.t_end` must be at most {MAX_STEPS:,} steps of dt, but dt is {dt:g} s."
    elif abs(steps - round(steps)) > 1e-6 * steps or round(steps) < 1:
        near = max(round(steps), 1) * dt
        wanted = f"a whole multiple of dt = {dt:g} s (nearest: {near:g})"
        yield f"`time.t_end` must be {wanted}, but is {t_end:g}."


def out_of_bounds(sweep: Sweep, dtype: str = "float64") -> Iterator[str]:
    """Values no scenario may have once they are `dtype`: bounds, the time grid, xb > x0."""
    good = True
    for section, fields in sweep.given().items():
        for name, values in fields.items():
            try:
                check_field(name, _cast(values, dtype), sweep.time.dt)
            except ParamsError as error:
                good = False
                yield f"`{section}.{name}` must be {error.wanted}, but is {error.value}."
    if not good:
        return
    extremes = Params(**{k: _cast(v, dtype) for k, v in vars(sweep.extremes()).items()})
    try:
        check(extremes, sweep.time.dt)
    except ParamsError as error:
        given = any(error.key in fields for fields in sweep.given().values())
        default = "" if given else " (the default)"
        yield f"`{error.key}` must be {error.wanted}, but is {error.value}{default}."


def _cast(values: Any, dtype: str) -> np.ndarray:
    with np.errstate(over="ignore", under="ignore"):  # told as inf or zero where it happens
        return np.asarray(values, dtype)
