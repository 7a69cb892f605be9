"""Checks of a Sweep that need more than one key; each yields a line for each mistake."""

import math
import re
from collections.abc import Container, Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from fic_jax import CHOICES, QUANTITIES, Model, Params, ParamsError
from fic_jax.params import check, check_field
from sweeps.spec.condition import ConditionError, names
from sweeps.spec.mistakes import excerpt, hint, misplaced
from sweeps.spec.types import (
    MAX_AXIS,
    MAX_CELLS,
    MAX_PERIODS,
    MAX_REDUCED,
    MAX_REFINED,
    MAX_RUNS,
    MAX_STEPS,
    MAX_VALUES,
    ROUNDING,
    STORED,
    Reduction,
    Refinement,
    SpacedRange,
    Sweep,
)

_SHARE = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,49}")  # `data.calm_share` of a store
TABLES = ("constants", "axes", "cases")


@dataclass(frozen=True)
class Wrong:
    """The entries that were left out of a Sweep for their types, as `axes.K0`.

    What follows from their absence is no mistake.
    """

    places: frozenset[str] = frozenset()

    def any(self, *keys: str) -> bool:
        """Whether a wrong entry lies in one of these tables, or is one of these entries."""
        return any(
            place == key or place.startswith(f"{key}.") for place in self.places for key in keys
        )

    @property
    def dimensions(self) -> bool:
        """Whether a dimension may be missing."""
        return self.any("axes", "model", "cases", "sample")


def unknown_names(sweep: Sweep) -> Iterator[str]:
    """Fields, choices and metrics that do not exist; choices and metrics listed twice."""
    for table, fields in sweep.values_to_check().items():
        for name in fields:
            if name not in QUANTITIES:
                unknown = f"unknown key `{table}.{name}`{hint(name, QUANTITIES)}"
                yield misplaced([table, name]) or unknown
    for name, chosen in sweep.model.items():
        if name not in CHOICES:
            unknown = f"unknown key `model.{name}`{hint(name, CHOICES)}"
            yield misplaced(["model", name]) or unknown
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
            yield f"unknown metric `{name}`{hint(name, STORED)}"
    if len(set(sweep.metrics)) < len(sweep.metrics):
        yield f"`metrics` must be different from each other, but is {sweep.metrics}."


def reduction(sweep: Sweep, wrong: Wrong) -> Iterator[str]:
    """Dimensions, metrics and conditions of a `[reduce]` that the sweep does not have."""
    if not (reduce := sweep.reduce):
        return
    yield from _dimensions(list(sweep.dims), reduce, wrong)
    metrics = list(sweep.metrics)
    # `best` wants `by`, which is one
    if not (reduce.metrics or reduce.share or reduce.best or wrong.any("reduce")):
        yield "`reduce` must name a statistic (max, min, mean, std, quantiles, share or best)."
    for key in ("max", "min", "mean", "std", "quantiles", "by"):
        listed = getattr(reduce, key) or []
        for name in [listed] if isinstance(listed, str) else listed:
            if name not in metrics:
                wanted = "must name metrics of the sweep"
                yield f"`reduce.{key}` {wanted}, but has `{name}`{_no_metric(name, metrics)}"
        if isinstance(listed, list) and len(set(listed)) < len(listed):
            yield f"`reduce.{key}` must be different from each other, but is {listed}."
    for name, parts in reduce.quantiles.items():
        if len(set(parts)) < len(parts):
            yield f"`reduce.quantiles.{name}` must be parts that differ, but is {parts}."
    yield from _conditions(reduce, metrics)
    yield from _reduced_sizes(sweep, reduce)


def _dimensions(dims: list[str], reduce: Reduction, wrong: Wrong) -> Iterator[str]:
    """Dimensions that go must be there, each once, and leave one."""
    for key, wanted in (("over", reduce.over), ("best", [reduce.best] if reduce.best else [])):
        for name in wanted:
            if name not in dims and not (wrong.dimensions or wrong.any(f"reduce.{key}")):
                held = " (which the sweep holds constant)" if name in QUANTITIES else ""
                there = f"; there are {', '.join(dims)}" if held else hint(name, dims)
                yield f"`reduce.{key}` must name dimensions, but has `{name}`{held}{there}"
    if len(set(reduce.over)) < len(reduce.over):
        yield f"`reduce.over` must be different from each other, but is {reduce.over}."
    if reduce.best in reduce.over:
        yield f"`reduce.best` must be a dimension that is not in `reduce.over`: `{reduce.best}`."
    if (reduce.best is None) != (reduce.by is None) and not wrong.any("reduce.best", "reduce.by"):
        given, missing = ("by", "best") if reduce.best is None else ("best", "by")
        yield f"`reduce.{missing}` must be given with `reduce.{given}`, but is missing."
    if dims and not set(dims) - set(reduce.gone) and not wrong.dimensions:
        yield "`reduce` must leave a dimension of the sweep, but `over` and `best` take all."


def _conditions(reduce: Reduction, metrics: list[str]) -> Iterator[str]:
    for name, text in reduce.share.items():
        if not _SHARE.fullmatch(name):
            wanted = "a letter, then letters, digits and _, at most 50"
            yield f"`reduce.share` must have names of {wanted}, but has {excerpt(name)}."
        if name in (*STORED, "diverged", "not_run") or name.endswith("_untrusted"):
            yield f"`reduce.share.{name}` must have another name: `{name}_share` is taken."
        try:
            used = names(text)
        except ConditionError as wanted:
            yield f"`reduce.share.{name}` must be {wanted}, but is {excerpt(text)}."
            continue
        unknowns = [n for n in used if n not in metrics and n not in QUANTITIES]
        for unknown in unknowns:
            known = hint(unknown, [*metrics, *QUANTITIES])
            yield f"`reduce.share.{name}` must have names of metrics and fields alone, but has " + (
                f"`{unknown}`{known}"
            )
        if not unknowns and not set(used) & set(metrics):
            yield f"`reduce.share.{name}` must name a metric, but is {excerpt(text)}."


def _reduced_sizes(sweep: Sweep, reduce: Reduction) -> Iterator[str]:
    """What a cell of the store is computed from must fit into a block, and quantiles in memory."""
    combinations = math.prod(sweep.dims.get(name, 1) for name in reduce.gone)
    if combinations > MAX_REDUCED:
        yield (
            f"`reduce` must make a cell of at most {MAX_REDUCED:,} scenarios, but takes "
            f"{excerpt(combinations)}: a block is lost with an interruption."
        )
    held = combinations * len(reduce.quantiles)
    if held > MAX_VALUES:
        yield (
            f"`reduce.quantiles` must be of at most {MAX_VALUES:,} values for each cell, but has "
            f"{excerpt(held)}: they are held in memory and sorted."
        )


def refinement(sweep: Sweep, wrong: Wrong) -> Iterator[str]:
    """What a `[refine]` names that the sweep does not have, and grids that are too large."""
    if not (refine := sweep.refine):
        return
    for table in ("sample", "reduce"):
        if getattr(sweep, table) or wrong.any(table):
            yield f"`refine` must be without `{table}`, but both are given."
    axes = refine.axes or []
    for name in axes:
        if wrong.any("axes") and name not in sweep.axes:
            continue
        if name not in sweep.axes:
            yield f"`refine.axes` must name axes, but has `{name}`{hint(name, sweep.axes)}"
        elif not isinstance(sweep.axes[name], SpacedRange):
            example = "{ log = [1, 100], n = 17 }"
            yield f"`refine.axes` must name ranges such as {example}, but `{name}` is a list."
    if len(set(axes)) < len(axes):
        yield f"`refine.axes` must be different from each other, but is {axes}."
    if not (sweep.refined or sweep.sample or wrong.dimensions):
        yield "`refine` must have an axis that is a range, but there is none."
    yield from _differences(sweep, refine, wrong)
    if not wrong.any("refine.levels", "refine.budget"):
        yield from _refined_sizes(sweep, refine)


def _differences(sweep: Sweep, refine: Refinement, wrong: Wrong) -> Iterator[str]:
    """What may differ in a box: conditions and metrics."""
    metrics = list(sweep.metrics)
    if not (refine.classes or refine.absolute or refine.relative or wrong.any("refine")):
        yield "`refine` must name classes or a metric (absolute, relative), but has neither."
    default = "" if "classes" in refine.model_fields_set else " (the default)"
    for text in refine.classes:
        try:
            used = names(text)
        except ConditionError as error:
            yield f"`refine.classes` must be {error}, but has {excerpt(text)}."
            continue
        for name in (n for n in used if n not in metrics):
            wanted = "must have names of metrics alone"
            has = f"has `{name}`{default}{_no_metric(name, metrics)}"
            yield f"`refine.classes` {wanted}, but {has}"
        if not used:
            yield f"`refine.classes` must name a metric, but has {excerpt(text)}."
    for key, table in (("absolute", refine.absolute), ("relative", refine.relative)):
        for name in (n for n in table if n not in metrics):
            wanted = "must name metrics of the sweep"
            yield f"`refine.{key}` {wanted}, but has `{name}`{_no_metric(name, metrics)}"
    for name in sorted(refine.absolute.keys() & refine.relative.keys()):
        yield f"`refine` must have one tolerance of `{name}`, but has two: absolute and relative."


def _no_metric(name: str, metrics: list[str]) -> str:
    """Why a name is no metric of the sweep."""
    return "; `metrics` lacks it" if name in STORED else hint(name, metrics)


def _refined_sizes(sweep: Sweep, refine: Refinement) -> Iterator[str]:
    """A refined grid must fit into memory, and its budget must do for the coarse one."""
    coarse = math.prod(sweep.model_copy(update={"refine": None}).dims.values())
    cells = math.prod(sweep.dims.values())
    if cells > MAX_REFINED or max(sweep.dims.values(), default=0) > MAX_AXIS:
        limit = f"at most {MAX_REFINED:,} cells, and {MAX_AXIS:,} along an axis"
        made = f"{refine.levels} of them make {excerpt(cells)}"
        yield f"`refine.levels` must make {limit}, but {made}."
        return
    if refine.budget is not None and refine.budget < coarse:
        wanted = f"at least {coarse:,}, the scenarios of the coarse grid"
        yield f"`refine.budget` must be {wanted}, but is {refine.budget:,}."
    if min(refine.budget or cells, cells) > MAX_RUNS:
        given = f"is {refine.budget:,}" if refine.budget else f"none is given for {cells:,} cells"
        yield f"`refine.budget` must be at most {MAX_RUNS:,}, but {given}."


def known_names(sweep: Sweep) -> Sweep:
    """The sweep without the names that `unknown_names` finds."""

    def known(table: dict[str, Any], names: Container[str]) -> dict[str, Any]:
        return {name: value for name, value in table.items() if name in names}

    tables: dict[str, Any] = {name: known(getattr(sweep, name), QUANTITIES) for name in TABLES}
    if sweep.sample:
        ranges = known(sweep.sample.ranges, QUANTITIES)
        tables["sample"] = sweep.sample.model_copy(update={"ranges": ranges})
    return sweep.model_copy(update=tables | {"model": known(sweep.model, CHOICES)})


def placement(sweep: Sweep) -> Iterator[str]:
    """Each field in one table; axes or a sample, not both; equally long cases; sizes in limits."""
    if sweep.sample and sweep.axes:
        yield "`sample` must be given instead of `axes`, but both are given."
    tables: dict[str, str] = {}
    for table, fields in sweep.values_to_check().items():
        for name in fields:
            if name in tables:
                yield f"`{table}.{name}` must be given once, but is in `{tables[name]}` too."
            tables[name] = table
    lengths = {name: len(values) for name, values in sweep.cases.items()}
    if len(set(lengths.values())) > 1:
        yield f"`cases` must be columns of equal length, but are {lengths}."
    for name in sweep.axes:
        axis = sweep.axis(name)
        if not (axis.distinct if isinstance(axis, SpacedRange) else _distinct(axis)):
            yield f"`axes.{name}` must be values that differ, but some are given twice."
    if sweep.sample and "period" in sweep.sample.ranges:
        yield "`sample.ranges.period` must be an axis or a case: it is a multiple of dt."
    yield from _sizes(sweep)


def _distinct(values: list[float]) -> bool:
    """Whether all values differ by more than rounding."""
    ordered = np.sort(values)
    return bool((np.diff(ordered) > ROUNDING * np.abs(ordered[1:])).all())


def _sizes(sweep: Sweep) -> Iterator[str]:
    cells, design = math.prod(sweep.dims.values()), sweep.sample
    if cells > MAX_CELLS:
        yield f"the sweep must have at most {MAX_CELLS:,} scenarios, but has {excerpt(cells)}."
    if design and design.method == "lhs" and design.n * len(design.ranges) > MAX_AXIS:
        most = MAX_AXIS // len(design.ranges)
        yield f"`sample.n` must be at most {most:,} with lhs, but is {design.n}."
    period = sweep.axis("period") if "period" in sweep.axes else None
    if isinstance(period, SpacedRange) and period.n > MAX_PERIODS:
        yield f"`axes.period.n` must be at most {MAX_PERIODS:,}, but is {period.n}."


def nothing_swept(sweep: Sweep) -> Iterator[str]:
    """At least one dimension."""
    if not sweep.dims:
        yield "`axes` must name at least one quantity to sweep, but is empty."


def time_grid(sweep: Sweep) -> Iterator[str]:
    """`t_end` must be a whole number of steps, at most MAX_STEPS."""
    dt, t_end = sweep.time.dt, sweep.time.t_end
    steps = t_end / dt if dt * MAX_STEPS > t_end / 2 else np.inf  # a tiny dt would overflow
    if steps > MAX_STEPS:
        yield f"`time.t_end` must be at most {MAX_STEPS:,} steps of dt, but dt is {dt:g} s."
    elif abs(steps - round(steps)) > 1e-6 * steps or round(steps) < 1:
        near = f"{max(round(steps), 1) * dt:.12g}"
        wanted = f"a whole multiple of dt = {dt:g} s (nearest: {near})"
        yield f"`time.t_end` must be {wanted}, but is {t_end:g}."


def out_of_bounds(sweep: Sweep, dtype: str = "float64") -> Iterator[str]:
    """Values that break a bound of fic_jax after rounding to `dtype`."""
    lines = list(fields_out_of_bounds(sweep, dtype))
    return iter(lines or pairs_out_of_bounds(sweep, dtype))


def fields_out_of_bounds(sweep: Sweep, dtype: str = "float64") -> Iterator[str]:
    """Values that break a bound of their own field."""
    for table, fields in sweep.values_to_check().items():
        for name, values in fields.items():
            try:
                check_field(name, _cast(values, dtype), sweep.time.dt)
            except ParamsError as error:
                yield f"`{table}.{name}` must be {error.wanted}, but is {error.value}."


def pairs_out_of_bounds(sweep: Sweep, dtype: str = "float64") -> Iterator[str]:
    """Values that break a bound which another field sets: xb > x0."""
    extremes = Params(**{k: _cast(v, dtype) for k, v in vars(sweep.extremes()).items()})
    try:
        check(extremes, sweep.time.dt)
    except ParamsError as error:
        given = any(error.key in fields for fields in sweep.values_to_check().values())
        default = "" if given else " (the default)"
        yield f"`{error.key}` must be {error.wanted}, but is {error.value}{default}."


def _cast(values: Any, dtype: str) -> np.ndarray:
    with np.errstate(over="ignore", under="ignore"):  # the checks then refuse inf and zero
        return np.asarray(values, dtype)
