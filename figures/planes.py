"""The plane of a heatmap, cut out of a store: two axes, the values, the cells without a value."""

import difflib
import json
import math
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fic_jax import QUANTITIES
from figures import style
from sweeps.store.format import (
    ERRORS,
    FLAGS,
    JUDGEMENTS,
    OK,
    OLD_JUDGEMENTS,
    STATUS,
    TRUSTED,
)


class PlotError(ValueError):
    """The data cannot give the requested figure; the text is one clear line."""


@dataclass(frozen=True)
class Axis:
    """One side of a heatmap: n values and n + 1 cell edges, on the scale of the drawing."""

    label: str
    scale: str  # "log" | "linear" | "category"
    values: NDArray[Any]
    edges: NDArray[np.float64]

    def place(self, values: NDArray[Any]) -> NDArray[Any]:
        """Position of values along the drawn side: 0 at its start, 1 at its end."""
        low, high = self.edges[0], self.edges[-1]
        if self.scale == "log":
            return np.asarray(np.log(values / low) / math.log(high / low))
        return np.asarray((values - low) / (high - low))


@dataclass(frozen=True)
class Plane:
    """One metric over two dimensions, `values[y, x]`; `special` says why a cell is masked."""

    x: Axis
    y: Axis
    metric: str
    label: str
    values: np.ma.MaskedArray[Any, Any]
    special: Mapping[str, NDArray[np.bool_]]  # reason, a key of style.HATCHES -> cells
    name: str  # of the sweep
    fixed: tuple[str, ...]  # "symbol = value unit" of each constant and each fixed dimension
    untrusted: NDArray[np.bool_] | None = None  # cells that ran but are not trusted; None: unknown
    trust_bound: str = ""  # largest error of a trusted cell, as a formula


def select(
    data: xr.Dataset,
    *,
    x: str,
    y: str,
    metric: str = "nmse",
    at: Mapping[str, float | str] | None = None,
) -> Plane:
    """Read one plane of a store.

    `at` fixes other dimensions, each at the value nearest to the wanted one. A dimension that
    nobody names is fixed at its middle. Raises PlotError if the store has no such plane.
    """
    at = at or {}
    _require_metric(metric, data)
    for name in (x, y, *at):
        along = data[name].dims if name in data.coords else (name,)
        if along != (name,) and name not in data.dims:
            raise PlotError(f"'{name}' varies along '{along[0]}', which has no grid to draw on.")
        _require(name, data[metric].dims, "dimension")
    if x == y:
        raise PlotError(f"x and y must be two dimensions, but both are '{x}'.")
    for name in {x, y} & set(at):
        raise PlotError(f"'{name}' is drawn as an axis; `at` cannot fix it too.")
    index = {
        str(dim): _position(data[dim], at[str(dim)]) if dim in at else data.sizes[dim] // 2
        for dim in data[metric].dims
        if dim not in (x, y)
    }
    wanted = [name for name in (metric, _judgement(data, metric), "status") if name in data]
    # isel before load: a store may be larger than memory, a plane is not
    plane = data[wanted].isel(index).load().transpose(y, x)
    for dim in (x, y):
        if _scale(plane[dim]) != "category" and not plane.indexes[dim].is_monotonic_increasing:
            plane = plane.sortby(dim)
    return _plane(plane, x, y, metric)


def _require_metric(metric: str, data: xr.Dataset) -> None:
    judgements = JUDGEMENTS | OLD_JUDGEMENTS
    if metric in (*ERRORS, *judgements) and not any(name in data for name in judgements):
        raise PlotError(
            f"There is no '{metric}': the store has no error estimates; "
            "`fic-sweep run --error-estimate` makes them."
        )
    if metric in judgements:
        judged = judgements[metric]
        raise PlotError(
            f"'{metric}' is no metric: the heatmap of '{judged}' hatches what is not trusted."
        )
    _require(metric, [name for name in data.data_vars if name not in FLAGS], "metric")


def _judgement(data: xr.Dataset, metric: str) -> str:
    """The flag that judges a metric, or the metric of an error; empty if the store has none."""
    judged = ERRORS.get(metric, metric)
    names = (name for name, of in (JUDGEMENTS | OLD_JUDGEMENTS).items() if of == judged)
    return next((name for name in names if name in data), "")


def _bound(data: xr.Dataset, judgement: str) -> str:
    """The bound of a judgement, as the store has it."""
    if judgement in OLD_JUDGEMENTS:
        return f"{100 * float(data.attrs.get('trust_bound', 0.01)):g} % of nmse"
    return str(data[judgement].attrs.get("bound", "its bound"))


def _require(name: str, known: Iterable[Hashable], what: str) -> None:
    names = [str(item) for item in known]
    if name in names:
        return
    lower = {item.lower(): item for item in names}
    near = difflib.get_close_matches(str(name).lower(), lower, n=1)
    hint = f" Did you mean '{lower[near[0]]}'?" if near else ""
    raise PlotError(f"There is no {what} '{name}'.{hint} There are: {', '.join(names)}.")


def _position(coordinate: xr.DataArray, wanted: float | str) -> int:
    """Index of the value nearest to `wanted`, on the scale of the axis."""
    name, values = str(coordinate.name), coordinate.values
    if values.dtype.kind not in "iuf":
        _require(str(wanted), values, f"value of {name}")
        return [str(value) for value in values].index(str(wanted))
    try:
        number = float(wanted)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise PlotError(f"{name} is numeric, but `at` names '{wanted}'.")
    if len(values) == 1 and not math.isclose(number, values[0], rel_tol=1e-6, abs_tol=1e-12):
        raise PlotError(f"{name} = {number:g} was not run; its only value is {values[0]:g}.")
    grid, scale = values.astype(float), _scale(coordinate)
    edges = _edges(np.sort(grid), scale if scale == "log" else "linear")
    if len(values) > 1 and not edges[0] <= number <= edges[-1]:
        span = f"{grid.min():g} to {grid.max():g} {style.units_text(_units(coordinate))}".strip()
        raise PlotError(f"{name} = {number:g} lies outside the sweep, which covers {span}.")
    ratio = np.log(grid) - math.log(number) if scale == "log" else grid - number
    return int(np.argmin(np.abs(ratio)))


def _plane(data: xr.Dataset, x: str, y: str, metric: str) -> Plane:
    array = data[metric]
    values = array.values.astype(float)
    # xarray decodes status 0, the fill value, as NaN
    status = np.nan_to_num(data["status"].values) if "status" in data else np.ones(values.shape)
    special = {key: status == code for key, code in STATUS.items() if code != OK}
    good = status == OK
    special["infinite"] = good & np.isinf(values)
    judgement = _judgement(data, metric)
    hidden = ~good | ~np.isfinite(values)
    special["no value"] = hidden & ~np.logical_or.reduce(list(special.values()))
    return Plane(
        x=_axis(data[x]),
        y=_axis(data[y]),
        metric=metric,
        label=_with_units(str(array.attrs.get("long_name", metric)), array),
        values=np.ma.masked_array(values, mask=hidden),
        special={key: cells for key, cells in special.items() if cells.any()},
        name=str(data.attrs.get("name", "")),
        fixed=(*_constants(data), *(_fixed(c) for c in data.coords.values() if c.ndim == 0)),
        untrusted=good & (data[judgement].values != TRUSTED) if judgement else None,
        trust_bound=_bound(data, judgement) if judgement else "",
    )


def _constants(data: xr.Dataset) -> Iterator[str]:
    """Model choices and parameters that the whole sweep holds constant."""
    record = json.loads(data.attrs.get("sweep", "{}"))
    for name, choice in record.get("model", {}).items():
        if isinstance(choice, str):
            yield f"{name} = {choice}"
    for name, value in record.get("constants", {}).items():
        units = style.units_text(QUANTITIES[name]["unit"])
        yield f"{style.SYMBOLS.get(name, name)} = {style.number(value)} {units}".strip()


def _units(array: xr.DataArray) -> str:
    return str(array.attrs.get("units", ""))


def _with_units(text: str, array: xr.DataArray) -> str:
    units = style.units_text(_units(array))
    return f"{text} ({units})" if units else text


def _symbol(coordinate: xr.DataArray) -> str:
    return style.SYMBOLS.get(str(coordinate.name), str(coordinate.name).replace("_", " "))


def _fixed(coordinate: xr.DataArray) -> str:
    value = coordinate.item()
    text = str(value) if isinstance(value, str | int) else style.number(float(value))
    return f"{_symbol(coordinate)} = {text} {style.units_text(_units(coordinate))}".strip()


def _axis(coordinate: xr.DataArray) -> Axis:
    scale = _scale(coordinate)
    return Axis(
        label=_with_units(_symbol(coordinate), coordinate),
        scale=scale,
        values=coordinate.values,
        edges=_edges(coordinate.values, scale),
    )


def _scale(coordinate: xr.DataArray) -> str:
    """The scale on which the values are most evenly spaced; "category" if they are no grid."""
    values = coordinate.values
    parameter = values.dtype.kind == "f" or (
        values.dtype.kind in "iu" and coordinate.name in style.SYMBOLS
    )
    if not parameter or len(np.unique(values)) < max(2, len(values)):
        return "category"
    ordered = np.sort(values.astype(float))
    positive = ordered[ordered > 0]
    wide = len(positive) > 1 and positive[-1] > 10**1.5 * positive[0]
    if len(positive) < len(ordered):
        # a log axis has no zero, and a linear axis would leave no room for the small decades
        return "category" if wide else "linear"
    # within a factor of two both scales look alike, and a log axis has no tick
    if wide or len(ordered) < 3 or ordered[-1] < 2 * ordered[0]:
        return "log" if wide else "linear"
    steps, ratios = np.diff(ordered), np.diff(np.log(ordered))
    uneven = np.std(steps) / np.mean(steps) > np.std(ratios) / np.mean(ratios)
    return "log" if uneven else "linear"


def _edges(values: NDArray[Any], scale: str) -> NDArray[np.float64]:
    """Cell edges midway between ascending values on the scale; outer cells are symmetric."""
    if scale == "category" or len(values) == 1:
        return np.arange(len(values) + 1, dtype=np.float64) - 0.5
    numbers = values.astype(np.float64)
    points: NDArray[np.float64] = np.log(numbers) if scale == "log" else numbers
    inner = (points[:-1] + points[1:]) / 2
    first, last = 2 * points[0] - inner[0], 2 * points[-1] - inner[-1]
    edges = np.concatenate([[first], inner, [last]]).astype(np.float64)
    if scale == "log":
        return np.asarray(np.exp(edges), dtype=np.float64)
    if points[0] > 0:
        edges[0] = max(edges[0], 0.0)  # a positive quantity has no negative edge
    return edges
