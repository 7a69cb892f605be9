"""A store as one table (CSV, Parquet), piece by piece, or one NetCDF file, variable by variable.

Units, meanings and constants are in the attributes of Parquet (pandas reads them as `frame.attrs`)
and NetCDF. Those of a CSV are in a second file: a comment in the first would end up in its data.
"""

import json
import math
import os
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from sweeps import disk
from sweeps.spec.mistakes import SweepError
from sweeps.store.format import FLAGS

SUFFIX = {"csv": ".csv", "parquet": ".parquet", "netcdf": ".nc"}
# what a table says beside its columns: constants, choices, what the metrics are
SAID = ("held", "held_by_default", "metrics_definition", "metrics_definition_meaning")
DESCRIPTION = "-metadata.json"  # suffix of the file that W3C's "CSV on the Web" looks for
PIECE = 500_000  # rows held at once


def write(data: xr.Dataset, path: Path, to: str) -> int:
    """Write the whole store to `path`; returns the number of scenarios.

    The file has its name, and replaces another of that name, once it is whole.
    """
    place = Path(os.path.realpath(path))  # a link stays a link
    whole = [(file.with_name(f".{file.name}.partial"), file) for file in files(place, to)]
    try:
        _WRITERS[to](data, whole[0][0])
        for partial, _ in whole[1:]:
            description = json.dumps(_description(data, place.name), indent=1)
            partial.write_text(description, encoding="utf-8")
        for partial, file in whole:
            partial.replace(file)
    except ImportError as error:
        raise SweepError(f"--to {to}: needs {error.name}; pip install 'fic-jax[export]'") from None
    except OSError as error:
        if disk.refused(error):
            number = error.errno or 0
            reason = f"can't be written: {os.strerror(number)}"
            raise OSError(number, reason, str(path)) from None
        raise SweepError(f"{path}: can't be written: {error.strerror or error}") from None
    finally:
        for partial, _ in whole:
            partial.unlink(missing_ok=True)
    return int(data["status"].size)


def files(path: Path, to: str) -> list[Path]:
    """The files that `write` writes: a table, and beside a CSV its units and constants."""
    return [path, path.with_name(path.name + DESCRIPTION)] if to == "csv" else [path]


def tables(data: xr.Dataset) -> Iterator[pd.DataFrame]:
    """One row a scenario: dimensions, swept fields, then the variables, flags in words."""
    order = list(map(str, data.sizes))
    fields = [name for name in data.coords if name not in data.dims]
    for piece in _pieces(dict(data["status"].sizes)):
        frame = data.isel(piece).to_dataframe(order).reset_index()
        frame.attrs = {key: data.attrs[key] for key in SAID if key in data.attrs}
        frame.attrs["units"] = {
            str(k): v.attrs.get("units", "1") for k, v in data.variables.items()
        }
        for name, flags in _flags(data):
            frame[name] = frame[name].map({code: word for word, code in flags.items()})
        yield frame[[*order, *fields, *data.data_vars]]


def _flags(data: xr.Dataset) -> Iterator[tuple[str, dict[str, int]]]:
    """The flag variables, each with its words and their codes."""
    for name, variable in data.data_vars.items():
        if name in FLAGS and "level" not in data:
            yield str(name), FLAGS[str(name)]
        elif "flag_values" in variable.attrs:  # of a reduced or a refined store
            words = str(variable.attrs["flag_meanings"]).split()
            yield str(name), dict(zip(words, variable.attrs["flag_values"], strict=True))


def _pieces(sizes: dict[Any, int]) -> Iterator[dict[Any, slice]]:
    """Stretches of at most PIECE cells in storage order: single indices, one range, whole rest."""
    names, lengths = list(sizes), list(sizes.values())
    split = next(i for i in range(len(names)) if math.prod(lengths[i + 1 :]) <= PIECE)
    step = PIECE // math.prod(lengths[split + 1 :])
    for index in np.ndindex(*lengths[:split]):
        for start in range(0, lengths[split], step):
            outer = {name: slice(i, i + 1) for name, i in zip(names, index, strict=False)}
            yield outer | {names[split]: slice(start, start + step)}


def _csv(data: xr.Dataset, path: Path) -> None:
    try:
        from pyarrow import Table
        from pyarrow.csv import CSVWriter, WriteOptions
    except ImportError:  # six times slower
        for i, frame in enumerate(tables(data)):
            frame.to_csv(path, mode="w" if i == 0 else "a", header=i == 0, index=False)
        return
    writer = None
    with path.open("wb") as file:
        for frame in tables(data):
            table = Table.from_pandas(frame, preserve_index=False)
            # our words and names need no quotes
            options = WriteOptions(quoting_style="none")
            writer = writer or CSVWriter(file, table.schema, write_options=options)
            writer.write_table(table)
        if writer:
            writer.close()


def _description(data: xr.Dataset, name: str) -> dict[str, Any]:
    """Columns, units and constants of a CSV in the vocabulary of W3C's "CSV on the Web"."""
    columns = [
        {
            "name": str(column),
            "dc:description": data[column].attrs.get("long_name", str(column)),
            "schema:unitText": data[column].attrs.get("units", "1"),
        }
        for column in next(tables(data.isel({dim: slice(1) for dim in data.dims}))).columns
    ]
    return {
        "@context": "http://www.w3.org/ns/csvw",
        "url": name,
        "dc:title": data.attrs["name"],
        "dc:description": data.attrs["description"],
        "tableSchema": {"columns": columns},
        "notes": [data.attrs | {"held": json.loads(data.attrs["held"])}],
    }


def _parquet(data: xr.Dataset, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    writer: Any = None
    with path.open("wb") as file:  # pyarrow can't open a name that the locale has no letters for
        for frame in tables(data):
            table = pa.Table.from_pandas(frame, preserve_index=False)
            writer = writer or pq.ParquetWriter(file, table.schema)
            writer.write_table(table)
        writer.close()


def _netcdf(data: xr.Dataset, path: Path) -> None:
    import h5netcdf  # noqa: F401  named here so that a missing one is told before anything is written

    plain = data.assign_coords(
        {k: v.astype(object) for k, v in data.coords.items() if v.dtype.kind == "T"}
    )
    # The attribute `coordinates` is Zarr's; xarray writes its own for NetCDF.
    plain.attrs = {k: v for k, v in data.attrs.items() if k != "coordinates"}
    for variable in plain.variables.values():
        variable.encoding = {}
    for name, flags in _flags(data):
        plain[name].encoding["_FillValue"] = None
        plain[name].attrs["flag_values"] = np.array(list(flags.values()), np.uint8)
    dask = sys.modules.get("dask")  # xarray would lock the file on a client that the user has
    here = dask.config.set(scheduler="synchronous") if dask else nullcontext()
    with (
        here,
        path.open("w+b") as file,
    ):  # HDF5 crashes the process where it can't write to its own file
        plain.to_netcdf(file, engine="h5netcdf")


_WRITERS = {"csv": _csv, "parquet": _parquet, "netcdf": _netcdf}
