"""A new store on disk: its attributes, coordinates and empty variables."""

import os
import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from fic_jax import METRICS, QUANTITIES, TRUST
from sweeps.plan.grid import Grid
from sweeps.spec.mistakes import SweepError
from sweeps.spec.types import Sweep
from sweeps.store import ledger as ledgers
from sweeps.store import lock as owner
from sweeps.store.fsync import PARTIAL, sync, sync_tree
from sweeps.store.ledger import Ledger
from sweeps.store.lock import owning
from sweeps.store.opening import (
    COORDINATE_CHUNK,
    ERRORS,
    FLAGS,
    FORMAT,
    Store,
    open_store,
    sha256,
    variable_names,
)

# One folder for each array, so that one look and one flush see all its chunks.
FLAT: Any = {"name": "default", "separator": "."}
ESTIMATE = (
    "Absolute error of the metric beside it, estimated by running the scenario again with half the "
    "plant step and its switches located inside the step; infinite where only one of the two runs "
    "gives a finite metric, NaN where one left the finite numbers."
)
MEANING = {  # of the flags
    "trusted": f"whether the estimated error of nmse is at most {100 * TRUST:g} % of nmse",
    "status": "what became of the scenario",
}


def create(path: Path, grid: Grid, attributes: Mapping[str, Any]) -> Store:
    """Make an empty store, whole or not at all. Raises SweepError if it can't be."""
    refuse_existing(path)
    refuse_small_disk(path, grid, attributes["dtype"])
    partial, there = path.with_name(f".{path.name}{PARTIAL}"), _existing_parent(path)
    try:
        with building(partial):
            lay_out(partial, grid, attributes)
            put_in_place(partial, path)
        for folder in path.absolute().parents:  # those made for it must be on the disk as well
            if folder.is_relative_to(there) and folder != path.absolute().parent:
                sync(folder)
    except OSError as error:
        raise SweepError(f"{path}: can't be written: {error.strerror or error}") from None
    return open_store(path)


def refuse_existing(path: Path) -> None:
    """Raise SweepError where something is in the way of a new store."""
    if path.exists() or path.is_symlink():
        store = os.path.isfile(path / "zarr.json")
        go_on = f"`fic-sweep resume {path}` continues it, " if store else ""
        raise SweepError(f"{path}: exists already; {go_on}--out names another")
    if os.path.lexists(away(path)):  # it would be taken for what has to be removed
        told = f"`fic-sweep resume {path}` finishes its extension, which was cut short"
        raise SweepError(f"{path}: {told}; --out names another")


def away(path: Path) -> Path:
    """Where a store waits until the larger one has its place."""
    return path.with_name(f".{path.name}.before")


def refuse_small_disk(path: Path, grid: Grid, dtype: str) -> None:
    """Raise SweepError where there is no room for a store."""
    needed, parent = size(grid, dtype), _existing_parent(path)
    free = shutil.disk_usage(parent).free
    if needed > free:
        raise SweepError(
            f"{path}: the sweep needs up to {needed / 1e9:.3g} GB for {grid.cells:,} cells, "
            f"but {parent} has {free / 1e9:.3g} GB free"
        )


@contextmanager
def building(partial: Path) -> Iterator[None]:
    """A folder to build a store in, owned by this process and gone afterwards if it is left there.

    What a killed process left there is removed first. Raises SweepError where another is at it.
    """
    partial.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        try:
            held.enter_context(owning(partial))
        except OSError:  # where another owned it, it would have been a SweepError
            shutil.rmtree(partial, ignore_errors=True)
            raise
        _clear(partial)
        try:
            yield
        finally:  # an interruption leaves no more behind than an error
            shutil.rmtree(partial, ignore_errors=True)


def put_in_place(partial: Path, path: Path) -> None:
    """Give a store its name, once all of it is on the disk."""
    sync_tree(partial)
    refuse_existing(path)
    partial.rename(path)
    sync(path.parent)


def _clear(folder: Path) -> None:
    for left in folder.iterdir():
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left)
        elif left.name != owner.NAME:
            left.unlink()


def size(grid: Grid, dtype: str) -> int:
    """Bytes of a finished store before compression: variables and coordinates."""
    names = variable_names(grid.sweep)
    cell = sum(1 if name in FLAGS else np.dtype(dtype).itemsize for name in names)
    coordinates = sum(n * 8 * len(grid.coordinates(d, slice(0, 1))) for d, n in grid.dims.items())
    return grid.cells * cell + coordinates


def _existing_parent(path: Path) -> Path:
    return next(folder for folder in path.absolute().parents if folder.exists())


def lay_out(path: Path, grid: Grid, attributes: Mapping[str, Any]) -> None:
    """Write the group, the coordinates, the metadata of every variable and an empty ledger."""
    sweep = grid.sweep
    record = {
        "format": FORMAT,
        "name": sweep.name,
        "description": sweep.description,
        "sweep": sweep.record(),
        "sweep_sha256": sha256(sweep.record()),
        "block_cells": grid.block_cells,
    } | _estimate(sweep)
    group = zarr.create_group(path, attributes=record | dict(attributes))
    along = [name for dim in grid.dims for name in _write_coordinates(group, grid, dim)]
    group.attrs.update({"coordinates": " ".join(along)} if along else {})
    for name in variable_names(sweep):
        group.create_array(**variable(grid, name, attributes["dtype"]))
    _consolidate(path)
    ledger = Ledger.create(path / ledgers.NAME)
    files = [path / "zarr.json", *sorted(p for p in path.glob("*/*") if p.is_file())]
    ledger.fix((file.relative_to(path).as_posix(), file.read_bytes()) for file in files)


def variable(grid: Grid, name: str, dtype: str) -> dict[str, Any]:
    """How zarr is to create what a store holds of every cell."""
    dtype, fill, described = _variable(name, dtype)
    return {
        "name": name,
        "shape": grid.shape,
        "chunks": grid.block_shape,
        "dimension_names": list(grid.dims),
        "dtype": dtype,
        "fill_value": fill,
        "compressors": _codecs(np.dtype(dtype).itemsize),
        "chunk_key_encoding": FLAT,
        # An all-NaN chunk must be a file too: a missing file then always means "not run".
        "config": {"write_empty_chunks": True},
        "attributes": described,
    }


def _consolidate(path: Path) -> None:
    """One file with all metadata: xarray opens it without a warning, and faster."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata")  # zarr: not in the v3 standard
        warnings.filterwarnings("ignore", "Object at owner.lock")  # of this process
        zarr.consolidate_metadata(path)


def _estimate(sweep: Sweep) -> dict[str, Any]:
    """Whether a store has error estimates (1/0), what they are and when a cell is trusted."""
    if not sweep.error_estimate:  # a number: NetCDF knows no true and false
        return {"error_estimate": 0}
    return {"error_estimate": 1, "error_estimate_meaning": ESTIMATE, "trust_bound": TRUST}


def _variable(name: str, dtype: str) -> tuple[str, float, dict[str, Any]]:
    """Type, fill value and attributes of what a store holds of every cell."""
    if name in FLAGS:
        flags = FLAGS[name]
        words = " ".join(word.replace(" ", "_") for word in flags)
        described = {"flag_values": list(flags.values()), "flag_meanings": words}
        return "uint8", 0, {"long_name": MEANING[name]} | described
    about = METRICS[ERRORS.get(name, name)]
    prefix = "estimated error of " if name in ERRORS else ""
    return dtype, np.nan, {"units": about["unit"], "long_name": prefix + about["meaning"]}


def _codecs(itemsize: int) -> list[Any]:
    """Compression with a checksum: Blosc alone reads most flipped bits as wrong numbers."""
    # lz4: as small as zstd's first level, on metrics, in half of its time
    return [BloscCodec(cname="lz4", clevel=9, shuffle="shuffle", typesize=itemsize), Crc32cCodec()]


def _write_coordinates(group: zarr.Group, grid: Grid, dim: str) -> list[str]:
    """Write what varies along a dimension, piece by piece; returns the names that are no index."""
    piece, length = COORDINATE_CHUNK, grid.dims[dim]
    for start in range(0, length, piece):
        part = slice(start, min(start + piece, length))
        for name, values in grid.coordinates(dim, part).items():
            if start == 0:
                about = QUANTITIES.get(name, {"unit": "1", "meaning": name})
                group.create_array(
                    name,
                    shape=(length,),
                    chunks=(min(piece, length),),
                    dtype=str if values.dtype.kind == "U" else values.dtype,
                    compressors=[Crc32cCodec()] if values.dtype.kind == "U" else _codecs(8),
                    dimension_names=[dim],
                    chunk_key_encoding=FLAT,
                    attributes={"units": about["unit"], "long_name": about["meaning"]},
                )
            array = group[name]
            assert isinstance(array, zarr.Array)
            array[part] = values
    return [name for name in grid.coordinates(dim, slice(0, 1)) if name != dim]
