"""The plane of a heatmap, cut out of a store: two axes and the cells between them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from figures.cut import (
    Cells,
    PlotError,
    Wanted,
    cells,
    cut,
    require_dimension,
    require_metric,
    scale_of,
    symbol,
    with_units,
)
from sweeps.maps import edges_of


@dataclass(frozen=True)
class Axis:
    """One side of a heatmap: n values and n + 1 cell edges, on the scale of the drawing."""

    name: str  # of the dimension or field
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
class Plane(Cells):
    """One metric over two dimensions, `values[y, x]`."""

    x: Axis
    y: Axis
    levels: int = 0  # how often both axes were halved at most


def select(
    data: xr.Dataset, *, x: str, y: str, metric: str = "nmse", at: Wanted | None = None
) -> Plane:
    """Read one plane of a store; `at` fixes other dimensions (`cut`).

    Raises PlotError if the store has no such plane.
    """
    require_metric(metric, data)
    along = {name: str(data[name].dims[0]) for name in (x, y) if name in data.coords}
    for name in (x, y):
        if along.get(name, name) == name:
            require_dimension(name, data, metric)
    for name, dim in along.items():
        if dim != name:
            raise PlotError(f"'{name}' varies along '{dim}', which has no grid to draw on.")
    if x == y:
        raise PlotError(f"x and y must be two dimensions, but both are '{x}'.")
    plane = cut(data, (x, y), metric, at or {}).transpose(y, x)
    for dim in (x, y):
        if scale_of(plane[dim]) != "category" and not plane.indexes[dim].is_monotonic_increasing:
            plane = plane.sortby(dim)
    halved = {x, y} <= set(str(data.attrs.get("refined_axes", "")).split())
    levels = int(data.attrs["refined_levels"]) if halved else 0
    return Plane(**vars(cells(plane, metric)), x=axis(plane[x]), y=axis(plane[y]), levels=levels)


def axis(coordinate: xr.DataArray) -> Axis:
    """A side of a picture along a dimension of a store."""
    scale = scale_of(coordinate)
    return Axis(
        name=str(coordinate.name),
        label=with_units(symbol(coordinate), coordinate),
        scale=scale,
        values=coordinate.values,
        edges=edges_of(coordinate.values, scale),
    )
