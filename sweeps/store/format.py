"""What a store has on the disk: its arrays, the flags of a cell, its attributes."""

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from zarr.codecs import BloscCodec, Crc32cCodec

from fic_jax import METRICS, QUANTITIES, TRUST
from sweeps.plan.grid import Grid
from sweeps.spec.types import STORED, Sweep

FORMAT = 2  # raise it with a change that older programs can't read

NOT_RUN, OK, DIVERGED, FAILED = range(4)
STATUS = {"not run": NOT_RUN, "ok": OK, "diverged": DIVERGED, "failed": FAILED}
NO_ESTIMATE, NOT_TRUSTED, TRUSTED = range(3)
TRUSTWORTHY = {"no estimate": NO_ESTIMATE, "not trusted": NOT_TRUSTED, "trusted": TRUSTED}
FLAGS = {"trusted": TRUSTWORTHY, "status": STATUS}  # flag variables; 0 is the fill value
FLAG_NAMES = {
    "trusted": f"whether the estimated error of nmse is at most {100 * TRUST:g} % of nmse",
    "status": "what became of the scenario",
}
ERRORS = {f"{name}_error": name for name in STORED}  # error estimate -> its metric
ESTIMATE = (
    "Absolute error of the metric beside it, estimated by running the scenario again with half the "
    "plant step and its switches located inside the step; infinite where only one of the two runs "
    "gives a finite metric, NaN where one left the finite numbers."
)
COORDINATE_CHUNK = 1_000_000  # values
# All chunks of an array in one folder: one scan lists them, one fsync keeps their names.
FLAT: Any = {"name": "default", "separator": "."}


def variable_names(sweep: Sweep) -> list[str]:
    """The variables of a store, in the order they are written."""
    estimates = [*(f"{name}_error" for name in sweep.metrics), "trusted"]
    return [*sweep.metrics, *(estimates if sweep.error_estimate else ()), "status"]


def arrays(grid: Grid, dtype: str) -> Iterator[dict[str, Any]]:
    """Arguments of `zarr.create_array` for each array of a store: coordinates, then variables."""
    for dim, length in grid.dims.items():
        for name, values in grid.coordinates(dim, slice(0, 1)).items():
            quantity = QUANTITIES.get(name, {"unit": "1", "meaning": name})
            text = values.dtype.kind == "U"
            yield {
                "name": name,
                "shape": (length,),
                "chunks": (min(COORDINATE_CHUNK, length),),
                "dimension_names": [dim],
                "dtype": np.dtypes.StringDType() if text else values.dtype,
                "compressors": [Crc32cCodec()] if text else _codecs(8),
                "chunk_key_encoding": FLAT,
                "attributes": {"units": quantity["unit"], "long_name": quantity["meaning"]},
            }
    for name in variable_names(grid.sweep):
        yield variable(grid, name, dtype)


def variable(grid: Grid, name: str, dtype: str) -> dict[str, Any]:
    """Arguments of `zarr.create_array` for a variable."""
    if name in FLAGS:
        dtype, fill = "uint8", 0.0
        attributes = {
            "long_name": FLAG_NAMES[name],
            "flag_values": list(FLAGS[name].values()),
            "flag_meanings": " ".join(word.replace(" ", "_") for word in FLAGS[name]),
        }
    else:
        fill, metric = np.nan, METRICS[ERRORS.get(name, name)]
        prefix = "estimated error of " if name in ERRORS else ""
        attributes = {"units": metric["unit"], "long_name": prefix + metric["meaning"]}
    return {
        "name": name,
        "shape": grid.shape,
        "chunks": grid.block_shape,
        "dimension_names": list(grid.dims),
        "dtype": np.dtype(dtype),
        "fill_value": fill,
        "compressors": _codecs(np.dtype(dtype).itemsize),
        "chunk_key_encoding": FLAT,
        # An all-NaN chunk is a file too: so a missing file always means "not run".
        "config": {"write_empty_chunks": True},
        "attributes": attributes,
    }


def attributes(grid: Grid) -> dict[str, Any]:
    """The attributes of a store that follow from its sweep."""
    sweep = grid.sweep
    record = {
        "format": FORMAT,
        "name": sweep.name,
        "description": sweep.description,
        "sweep": sweep.record(),
        "sweep_sha256": sha256(sweep.record()),
        "block_cells": grid.block_cells,
        "error_estimate": int(sweep.error_estimate),  # NetCDF knows no booleans
    }
    if sweep.error_estimate:
        record |= {"error_estimate_meaning": ESTIMATE, "trust_bound": TRUST}
    return record


def size(grid: Grid, dtype: str) -> int:
    """Bytes of a finished store before compression: variables and coordinates."""
    names = variable_names(grid.sweep)
    cell = sum(1 if name in FLAGS else np.dtype(dtype).itemsize for name in names)
    coordinates = sum(n * 8 * len(grid.coordinates(d, slice(0, 1))) for d, n in grid.dims.items())
    return grid.cells * cell + coordinates


def sha256(record: str) -> str:
    """The hash of a sweep record: of its text, so that fields of later versions change nothing."""
    return hashlib.sha256(record.encode()).hexdigest()


def _codecs(itemsize: int) -> list[Any]:
    """Compression and a CRC: Blosc alone reads most flipped bits as wrong numbers."""
    # lz4: as small as zstd's first level, on metrics, in half the time
    return [BloscCodec(cname="lz4", clevel=9, shuffle="shuffle", typesize=itemsize), Crc32cCodec()]
