"""The picture that a request names: a heatmap, a line or dots."""

from collections.abc import Mapping

import xarray as xr
from matplotlib.figure import Figure

from figures import heatmap, planes, points
from figures.cut import Wanted
from figures.planes import Plane
from figures.points import Points


def choose(
    data: xr.Dataset,
    *,
    x: str | None = None,
    y: str | None = None,
    metric: str = "nmse",
    at: Wanted | None = None,
) -> Plane | Points:
    """What a store has for a picture of `metric` over `x`, or over `x` and `y`.

    Dimensions x and y: a plane. A dimension x alone: a line. Fields that vary along one dimension:
    dots. `at` fixes the other dimensions (`cut`). Raises PlotError if the store can't answer.
    """
    if x is not None and y is not None and not _one_dimension(data, x, y):
        return planes.select(data, x=x, y=y, metric=metric, at=at)
    return points.select(data, x=x, y=y, metric=metric, at=at)


def draw(picture: Plane | Points) -> Figure:
    """The figure of a picture."""
    return heatmap.draw(picture) if isinstance(picture, Plane) else points.draw(picture)


def plot(
    data: xr.Dataset,
    *,
    x: str | None = None,
    y: str | None = None,
    metric: str = "nmse",
    at: Mapping[str, float | str] | None = None,
) -> Figure:
    """Draw `metric` over one or two dimensions, or fields, of a store (`choose`)."""
    return draw(choose(data, x=x, y=y, metric=metric, at=at))


def _one_dimension(data: xr.Dataset, x: str, y: str) -> bool:
    """Whether both are fields along one dimension."""
    dims = [data[name].dims for name in (x, y) if name in data.coords]
    return len(dims) == 2 and dims[0] == dims[1] and len(dims[0]) == 1
