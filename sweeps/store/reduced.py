"""The variables of a reduced store: names, units, meanings, flags.

Each statistic has beside it, under a name that begins with the same metric or condition, a status
(`nmse_status`), and the share of its scenarios that are not trusted (`nmse_untrusted_share`).
`diverged_share` and `not_run_share` are of all statistics alike.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from fic_jax import METRICS, QUANTITIES
from sweeps.plan.grid import Grid
from sweeps.plan.random_design import draw
from sweeps.spec import condition
from sweeps.spec.types import Reduction, Sweep

NOT_TRUSTED = "not trusted"
NONE = "none"  # the flag of a choice where there is none


@dataclass(frozen=True)
class Variable:
    """A variable of a reduced store."""

    name: str
    long_name: str
    units: str = "1"
    dtype: str = ""  # empty: the precision of the metrics
    flags: dict[str, int] = field(
        default_factory=dict
    )  # word -> code, in uint8; 0 is the fill value
    status: str = ""  # the variable that says what became of it
    place: str = ""  # the field or choice of which it has values


def variables(sweep: Sweep, status: dict[str, int]) -> dict[str, Variable]:
    """The variables of a reduced sweep, in the order they are written; flags of a status."""
    assert sweep.reduce
    return {one.name: one for one in _variables(sweep, sweep.reduce, status)}


def conditions(reduce: Reduction, metrics: list[str]) -> dict[str, list[str]]:
    """The metrics that each condition needs."""
    return {
        name: [used for used in condition.names(text) if used in metrics]
        for name, text in reduce.share.items()
    }


def quantile(metric: str, part: float) -> str:
    """The name of a quantile: `nmse_q95`, or `nmse_q99_9` of 0.999."""
    return f"{metric}_q{100 * part:.10g}".replace(".", "_")


def place_names(sweep: Sweep, dim: str) -> list[str]:
    """What the store says of a place along a dimension that goes.

    The value of an axis or a choice; of a case its number and its columns; of a drawn scenario its
    number and its fields.
    """
    if dim == "scenario" and sweep.sample:
        return [dim, *sweep.sample.ranges]
    return [dim, *sweep.cases] if dim == "case" else [dim]


def _variables(sweep: Sweep, reduce: Reduction, status: dict[str, int]) -> Iterator[Variable]:
    over = f"over {', '.join(reduce.over)}"
    if reduce.best:
        worst = f"largest {_words(str(reduce.by))} {over}"
        over += f", at the best {reduce.best}"
        for name in place_names(sweep, reduce.best):
            what = f"whose {worst} is smallest"
            yield _place(sweep, f"best_{name}", name, what, f"{reduce.by}_status")
        units = METRICS[str(reduce.by)]["unit"]
        meaning = f"{worst}, at the best {reduce.best}"
        yield Variable(f"{reduce.by}_at_best", meaning, units, status=f"{reduce.by}_status")
    for metric in reduce.metrics:
        yield from _of_metric(sweep, reduce, metric, over)
    for name, text in reduce.share.items():
        meaning = f"part of the scenarios in which {text}, {over}"
        yield Variable(f"{name}_share", meaning, status=f"{name}_status")
    for name in (*reduce.metrics, *reduce.share):
        meaning = f"what became of the scenarios that {name} needs"
        yield Variable(f"{name}_status", meaning, dtype="uint8", flags=status)
        if sweep.error_estimate:
            meaning = f"part of the scenarios in which {name} is not trusted, {over}"
            yield Variable(f"{name}_untrusted_share", meaning)
    yield Variable("diverged_share", f"part of the scenarios that diverged, {over}")
    yield Variable("not_run_share", f"part of the scenarios that were not run or failed, {over}")


def _words(metric: str) -> str:
    """A metric in few words: a picture's label has little room, and the docs explain it."""
    return metric.replace("_", " ")


def _of_metric(sweep: Sweep, reduce: Reduction, metric: str, over: str) -> Iterator[Variable]:
    meaning, units = _words(metric), METRICS[metric]["unit"]
    state = f"{metric}_status"
    for key, word in (("max", "largest"), ("min", "smallest")):
        if metric not in getattr(reduce, key):
            continue
        yield Variable(f"{metric}_{key}", f"{word} {meaning} {over}", units, status=state)
        for dim in reduce.over:
            for name in place_names(sweep, dim):
                what = f"of the {word} {meaning}"
                yield _place(sweep, f"{metric}_{key}_{name}", name, what, state)
    if metric in reduce.mean:
        yield Variable(f"{metric}_mean", f"mean {meaning} {over}", units, status=state)
    if metric in reduce.std:
        said = f"standard deviation of {meaning} {over}"
        yield Variable(f"{metric}_std", said, units, status=state)
    for part in reduce.quantiles.get(metric, ()):
        said = f"{100 * part:.10g} % quantile of {meaning} {over}"
        yield Variable(quantile(metric, part), said, units, status=state)


def _place(sweep: Sweep, variable: str, name: str, what: str, status: str) -> Variable:
    """The value at a place: a number in double precision, so that `.sel` finds it, or a choice."""
    if name in sweep.model:
        flags = {choice: i for i, choice in enumerate([NONE, *sweep.model[name]])}
        return Variable(
            variable, f"{name} {what}", dtype="uint8", flags=flags, status=status, place=name
        )
    quantity = QUANTITIES.get(name, {"unit": "1", "meaning": f"number of the {name}"})
    meaning = f"{quantity['meaning']} {what}"
    return Variable(variable, meaning, quantity["unit"], "float64", status=status, place=name)


def place_values(grid: Grid, dim: str, index: np.ndarray) -> dict[str, np.ndarray]:
    """What the store says of places along a dimension, by `place_names`; none where negative."""
    known, at = index >= 0, np.maximum(index, 0)
    if dim in grid.sweep.model:
        return {dim: np.where(known, at + 1, 0)}
    if dim == "scenario" and grid.sweep.sample:  # a design of millions is not drawn for a few
        numbers, at = np.unique(at, return_inverse=True)
        drawn = [draw(grid.sweep.sample, i, i + 1) for i in numbers.tolist()]
        along = {n: np.concatenate([one[n] for one in drawn]) for n in grid.sweep.sample.ranges}
        along[dim] = numbers
    else:
        along = grid.full.coordinates(dim)
    return {n: np.where(known, along[n][at], np.nan) for n in place_names(grid.sweep, dim)}
