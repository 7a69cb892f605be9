"""One plane of a store, cut out, scaled and sorted for drawing: axes, values, special cells."""

import difflib
import json
import math
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fic_jax import QUANTITIES, TRUST
from figures import style
from sweeps.store.format import ERRORS, FLAGS, OK, STATUS, TRUSTED


class PlotError(ValueError):
    """A figure was asked for that the data cannot give; one clear line."""


@dataclass(frozen=True)
class Axis:
    """One side of a heatmap: n values, n + 1 cell edges in the scale they are drawn in."""

    label: str
    scale: str  # "log" | "linear" | "category"
    values: NDArray[Any]
    edges: NDArray[np.float64]

    def place(self, values: NDArray[Any]) -> NDArray[Any]:
        """Where values lie along the drawn side: 0 at its start, 1 at its end."""
        low, high = self.edges[0], self.edges[-1]
        if self.scale == "log":
            return np.asarray(np.log(values / low) / math.log(high / low))
        return np.asarray((values - low) / (high - low))


@dataclass(frozen=True)
class Slice:
    """One plane of a store, `values[y, x]`; masked cells are named in `special`."""

    x: Axis
    y: Axis
    metric: str
    label: str
    values: np.ma.MaskedArray[Any, Any]
    special: Mapping[str, NDArray[np.bool_]]  # hatch name -> cells
    name: str
    fixed: tuple[str, ...]  # "symbol = value unit" of everything held constant
    untrusted: NDArray[np.bool_] | None = None  # good but not trusted; None without estimates
    bound: float = TRUST  # relative error of nmse up to which a cell is trusted


def select(
    data: xr.Dataset,
    *,
    x: str,
    y: str,
    metric: str = "nmse",
    at: Mapping[str, float | str] | None = None,
) -> Slice:
    """Read one plane: nearest values to `at`, the middle of every dimension nobody named."""
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
        raise PlotError(f"'{name}' is drawn as an axis; it cannot also be fixed by at.")
    index = {
        str(dim): _position(data[dim], at[str(dim)]) if dim in at else data.sizes[dim] // 2
        for dim in data[metric].dims
        if dim not in (x, y)
    }
    wanted = [metric, *(name for name in FLAGS if name in data)]
    # isel before load: a store may be larger than memory, a plane of it never is
    plane = data[wanted].isel(index).load().transpose(y, x)
    for dim in (x, y):
        if _scale(plane[dim]) != "category" and not plane.indexes[dim].is_monotonic_increasing:
            plane = plane.sortby(dim)
    return _slice(plane, x, y, metric)


def _require_metric(metric: str, data: xr.Dataset) -> None:
    estimated = "trusted" in data
    if metric in (*ERRORS, "trusted") and not estimated:
        raise PlotError(
            f"There is no '{metric}': the store has no error estimates; "
            "`fic-sweep run --error-estimate` makes them."
        )
    if metric == "trusted":
        raise PlotError(
            "'trusted' is no metric: the heatmap of any metric hatches what is not trusted."
        )
    _require(metric, [name for name in data.data_vars if name not in FLAGS], "metric")


def _require(name: str, known: Iterable[Hashable], what: str) -> None:
    names = [str(item) for item in known]
    if name in names:
        return
    lower = {item.lower(): item for item in names}
    near = difflib.get_close_matches(str(name).lower(), lower, n=1)
    hint = f" Did you mean '{lower[near[0]]}'?" if near else ""
    raise PlotError(f"There is no {what} '{name}'.{hint} There are: {', '.join(names)}.")


def _position(coordinate: xr.DataArray, wanted: float | str) -> int:
    """Index of the grid value nearest to `wanted`, in the scale of the axis."""
    name, values = str(coordinate.name), coordinate.values
    if values.dtype.kind not in "iuf":
        _require(str(wanted), values, f"value of {name}")
        return [str(value) for value in values].index(str(wanted))
    try:
        number = float(wanted)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise PlotError(f"{name} is numeric, but at asks for '{wanted}'.")
    if len(values) == 1 and not math.isclose(number, values[0], rel_tol=1e-6, abs_tol=1e-12):
        raise PlotError(f"{name} = {number:g} was not run; its only value is {values[0]:g}.")
    grid, scale = values.astype(float), _scale(coordinate)
    edges = _edges(np.sort(grid), scale if scale == "log" else "linear")
    if len(values) > 1 and not edges[0] <= number <= edges[-1]:
        span = f"{grid.min():g} to {grid.max():g} {style.units_text(_units(coordinate))}".strip()
        raise PlotError(f"{name} = {number:g} lies outside the sweep, which covers {span}.")
    ratio = np.log(grid) - math.log(number) if scale == "log" else grid - number
    return int(np.argmin(np.abs(ratio)))


def _slice(plane: xr.Dataset, x: str, y: str, metric: str) -> Slice:
    array = plane[metric]
    values = array.values.astype(float)
    # a decoded fill value turns status 0 into NaN
    status = np.nan_to_num(plane["status"].values) if "status" in plane else np.ones(values.shape)
    special = {key: status == code for key, code in STATUS.items() if code != OK}
    good = status == OK
    special["infinite"] = good & np.isinf(values)
    hidden = ~good | ~np.isfinite(values)
    special["no value"] = hidden & ~np.logical_or.reduce(list(special.values()))
    return Slice(
        x=_axis(plane[x]),
        y=_axis(plane[y]),
        metric=metric,
        label=_with_units(str(array.attrs.get("long_name", metric)), array),
        values=np.ma.masked_array(values, mask=hidden),
        special={key: cells for key, cells in special.items() if cells.any()},
        name=str(plane.attrs.get("name", "")),
        fixed=(*_constants(plane), *(_fixed(c) for c in plane.coords.values() if c.ndim == 0)),
        untrusted=good & (plane["trusted"].values != TRUSTED) if "trusted" in plane else None,
        bound=float(plane.attrs.get("trust_bound", TRUST)),
    )


def _constants(plane: xr.Dataset) -> Iterator[str]:
    """What the sweep's record holds constant: choices of the model and parameters."""
    record = json.loads(plane.attrs.get("sweep", "{}"))
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
    """How the values are spaced: evenly, by ratio, or not as numbers at all."""
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
        # zero has no place on a log axis, and a linear one would squeeze the decades to nothing
        return "category" if wide else "linear"
    # within a factor of two both scales look alike and a log axis finds no ticks
    if wide or len(ordered) < 3 or ordered[-1] < 2 * ordered[0]:
        return "log" if wide else "linear"
    steps, ratios = np.diff(ordered), np.diff(np.log(ordered))
    uneven = np.std(steps) / np.mean(steps) > np.std(ratios) / np.mean(ratios)
    return "log" if uneven else "linear"


def _edges(values: NDArray[Any], scale: str) -> NDArray[np.float64]:
    """Cell edges midway between ascending values in the scale; the outer cells are symmetric."""
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
        edges[0] = max(edges[0], 0.0)  # a positive quantity gets no negative axis
    return edges
