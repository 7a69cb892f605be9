"""`plot` and `export`: a store as a picture, a table or a NetCDF file."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sweeps.cli.arguments import NewFile, StorePath
from sweeps.cli.errors import refuse, unreadable_refused

if TYPE_CHECKING:
    import xarray as xr


class Format(StrEnum):
    """What `export` writes."""

    csv = "csv"
    parquet = "parquet"
    netcdf = "netcdf"


def plot(
    path: StorePath,
    x: Annotated[str, typer.Option(help="dimension of the horizontal axis")],
    y: Annotated[str, typer.Option(help="dimension of the vertical axis")],
    metric: Annotated[str, typer.Option(help="variable shown as colour")] = "nmse",
    at: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="value of another dimension")
    ] = None,
    out: NewFile = None,
) -> None:
    """Draw a heatmap of a metric over two dimensions."""
    from figures import PlotError, save
    from figures import plot as draw
    from sweeps.store.opening import dataset

    data, fixed = dataset(path), _fixed(at or [])
    with unreadable_refused(path):
        try:
            figure = draw(data, x=x, y=y, metric=metric, at=fixed)
        except PlotError as error:
            refuse(f"{path}: {error}")
    target = out or Path(f"{data.attrs['name']}-{metric}.png")
    try:
        save(figure, target)
    except (OSError, ValueError) as error:
        refuse(f"{target}: can't be written: {error}")
    print(f"wrote {target}{_old_definition(data)}")


def _old_definition(data: "xr.Dataset") -> str:
    """What the metrics are, if this program would compute others."""
    from sweeps.store.format import DEFINITION

    old = data.attrs["metrics_definition"] != DEFINITION
    return f"; its metrics are {data.attrs['metrics_definition_meaning']}" if old else ""


def _fixed(at: list[str]) -> dict[str, str]:
    """`--at KEY=VALUE`: dimension -> its value."""
    fixed: dict[str, str] = {}
    for text in at:
        key, _, value = (part.strip() for part in text.partition("="))
        if not (key and value):
            refuse(f"--at {text}: must be KEY=VALUE, as in --at Td=5")
        if key in fixed:
            refuse(f"--at {key}={value}: {key} is given twice")
        fixed[key] = value
    return fixed


def export(
    path: StorePath,
    to: Annotated[Format, typer.Option(help="format to write")],
    out: NewFile = None,
) -> None:
    """Write a store as one table or one NetCDF file."""
    from sweeps.export import SUFFIX, write
    from sweeps.store.opening import dataset

    data = dataset(path)
    target = out or Path(f"{data.attrs['name']}{SUFFIX[to.value]}")
    with unreadable_refused(path):
        rows = write(data, target, to.value)
    print(f"wrote {target}, {rows:,} scenarios{_old_definition(data)}")
