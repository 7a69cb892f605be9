"""A store as one table (CSV, Parquet) or one NetCDF file, piece by piece."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from sweeps.spec import SweepError
from sweeps.store import STATUS

SUFFIX = {"csv": ".csv", "parquet": ".parquet", "netcdf": ".nc"}
PIECE = 500_000  # rows held at once


def write(data: xr.Dataset, path: Path, to: str) -> int:
    """Write the whole store to `path`, which must not exist; returns the number of scenarios."""
    if path.exists():
        raise SweepError(f"{path}: exists already; --out names another")
    try:
        _WRITERS[to](data, path)
    except ImportError as error:
        raise SweepError(f"--to {to}: needs {error.name}; pip install 'fic-jax[export]'") from None
    except OSError as error:
        raise SweepError(f"{path}: can't be written: {error.strerror or error}") from None
    return int(data["status"].size)


def tables(data: xr.Dataset) -> Iterator[pd.DataFrame]:
    """One row a scenario, dimensions and swept fields as columns, `status` in words."""
    words = {code: name for name, code in STATUS.items()}
    first = next(iter(data.sizes))
    others = data["status"].size // data.sizes[first]
    step = max(1, PIECE // others)
    for start in range(0, data.sizes[first], step):
        frame = data.isel({first: slice(start, start + step)}).to_dataframe(
            list(map(str, data.sizes))
        )
        frame = frame.reset_index()
        frame["status"] = frame["status"].map(words)
        yield frame


def _csv(data: xr.Dataset, path: Path) -> None:
    for i, frame in enumerate(tables(data)):
        frame.to_csv(path, mode="w" if i == 0 else "a", header=i == 0, index=False)


def _parquet(data: xr.Dataset, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    writer: Any = None
    for frame in tables(data):
        table = pa.Table.from_pandas(frame, preserve_index=False)
        writer = writer or pq.ParquetWriter(path, table.schema)
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
    plain["status"].encoding["_FillValue"] = None
    plain["status"].attrs["flag_values"] = np.array(list(STATUS.values()), np.uint8)
    plain.to_netcdf(path, engine="h5netcdf")


_WRITERS = {"csv": _csv, "parquet": _parquet, "netcdf": _netcdf}
