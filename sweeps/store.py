"""The result store: one Zarr directory that `xarray.open_zarr` reads with no code of ours.

Block = chunk = unit of commit. A block's metrics are written first and its `status` last, each
file by a rename, so that a block counts as done when, and only when, its status says so.
"""

import hashlib
import os
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from fic_jax import METRICS, QUANTITIES, Metrics
from sweeps.grid import Block, Grid
from sweeps.spec import Sweep, SweepError

if TYPE_CHECKING:
    import xarray as xr

NOT_RUN, OK, DIVERGED, FAILED = range(4)
STATUS = {"not run": NOT_RUN, "ok": OK, "diverged": DIVERGED, "failed": FAILED}
FORMAT = 1  # of the store; a change that older programs can't read adds one


@dataclass(frozen=True)
class Store:
    """An open store: where it is, its plan, its arrays."""

    path: Path
    grid: Grid
    group: zarr.Group

    @property
    def dtype(self) -> str:
        """Precision of the metrics, `float32` or `float64`."""
        return str(self.group.attrs["dtype"])

    def pending(self) -> list[Block]:
        """Blocks that are not done, in storage order."""
        status = self._array("status")
        return [block for block in self.grid.blocks() if np.any(status[block] == NOT_RUN)]

    def counts(self) -> dict[str, int]:
        """Cells of each status, counted block by block."""
        status, total = self._array("status"), np.zeros(len(STATUS), np.int64)
        for block in self.grid.blocks():
            total += np.bincount(np.ravel(status[block]), minlength=len(STATUS))
        return dict(zip(STATUS, total.tolist(), strict=True))

    def write(self, block: Block, metrics: Metrics) -> int:
        """Commit one block; returns how many of its scenarios diverged.

        A diverged scenario keeps no metrics: its cells are NaN and its status says why.
        """
        shape = tuple(part.stop - part.start for part in block)
        for name in self.grid.sweep.metrics:
            values = np.where(metrics.finite, getattr(metrics, name), np.nan)
            array = self._array(name)
            array[block] = values.reshape(shape).astype(array.dtype)
        status = np.where(metrics.finite, OK, DIVERGED).astype(np.uint8)
        self._array("status")[block] = status.reshape(shape)
        return int((~metrics.finite).sum())

    def note(self, **attributes: str) -> None:
        """Add attributes, visible to whoever opens the store next."""
        self.group.attrs.update(attributes)
        _consolidate(self.path)

    def _array(self, name: str) -> zarr.Array[Any]:
        array = self.group[name]
        assert isinstance(array, zarr.Array)
        return array


def create(path: Path, grid: Grid, attributes: Mapping[str, Any]) -> Store:
    """Make an empty store, whole or not at all. Raises SweepError if it can't be."""
    if path.exists() or path.is_symlink():
        store = os.path.isfile(path / "zarr.json")
        go_on = f"`fic-sweep resume {path}` continues it, " if store else ""
        raise SweepError(f"{path}: exists already; {go_on}--out names another")
    needed, parent = size(grid, attributes["dtype"]), _existing_parent(path)
    free = shutil.disk_usage(parent).free
    if needed > free:
        raise SweepError(
            f"{path}: the sweep needs up to {needed / 1e9:.3g} GB for {grid.cells:,} cells, "
            f"but {parent} has {free / 1e9:.3g} GB free"
        )
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        _lay_out(partial, grid, attributes)
        partial.rename(path)
    except OSError as error:
        raise SweepError(f"{path}: can't be written: {error.strerror or error}") from None
    finally:  # an interruption leaves no more behind than an error
        shutil.rmtree(partial, ignore_errors=True)
    return open_store(path)


def open_store(path: Path, mode: Any = "r+") -> Store:
    """Open a store and rebuild its plan. Raises SweepError if it is none or was tampered with."""
    if not os.path.isfile(path / "zarr.json"):  # False, too, for a name no file may have
        raise SweepError(f"{path}: is no result store (no zarr.json in it)")
    try:
        group = zarr.open_group(path, mode=mode)
        attributes = group.attrs.asdict()
        record = str(attributes["sweep"])
        sweep = Sweep.model_validate_json(record)
        chunk, written = int(str(attributes["block_cells"])), attributes["sweep_sha256"]
    except (KeyError, ValueError, OSError) as error:
        raise SweepError(f"{path}: is no result store of fic-sweep ({error})"[:200]) from None
    if attributes["format"] != FORMAT:
        raise SweepError(f"{path}: has format {attributes['format']}; this program reads {FORMAT}")
    if sha256(record) != written:
        raise SweepError(f"{path}: its sweep record differs from the one that began it")
    return Store(path, Grid(sweep, chunk), group)


def sha256(record: str) -> str:
    """What a sweep record is recognised by: its text, so that later fields change nothing."""
    return hashlib.sha256(record.encode()).hexdigest()


def size(grid: Grid, dtype: str) -> int:
    """Bytes of a finished store before compression: metrics, status, coordinates."""
    coordinates = sum(n * 8 * len(grid.coordinates(d, slice(0, 1))) for d, n in grid.dims.items())
    return grid.cells * (len(grid.sweep.metrics) * np.dtype(dtype).itemsize + 1) + coordinates


def _existing_parent(path: Path) -> Path:
    return next(folder for folder in path.absolute().parents if folder.exists())


def _lay_out(path: Path, grid: Grid, attributes: Mapping[str, Any]) -> None:
    """Write the group, the coordinates and the metadata of every variable."""
    sweep = grid.sweep
    record = {
        "format": FORMAT,
        "name": sweep.name,
        "description": sweep.description,
        "sweep": sweep.record(),
        "sweep_sha256": sha256(sweep.record()),
        "block_cells": grid.block_cells,
    }
    group = zarr.create_group(path, attributes=record | dict(attributes))
    along = [name for dim in grid.dims for name in _write_coordinates(group, grid, dim)]
    group.attrs.update({"coordinates": " ".join(along)} if along else {})
    layout: dict[str, Any] = {"shape": grid.shape, "chunks": grid.block_shape}
    layout["dimension_names"] = list(grid.dims)
    # An all-NaN chunk must be a file too: a missing file then always means "not run".
    layout["config"] = {"write_empty_chunks": True}
    for name in sweep.metrics:
        dtype = attributes["dtype"]
        described = {"units": METRICS[name]["unit"], "long_name": METRICS[name]["meaning"]}
        codecs = _codecs(np.dtype(dtype).itemsize)
        group.create_array(
            name,
            dtype=dtype,
            fill_value=np.nan,
            compressors=codecs,
            attributes=described,
            **layout,
        )
    described = {
        "long_name": "what became of the scenario",
        "flag_values": list(STATUS.values()),
        "flag_meanings": " ".join(name.replace(" ", "_") for name in STATUS),
    }
    group.create_array(
        "status",
        dtype="uint8",
        fill_value=NOT_RUN,
        compressors=_codecs(1),
        attributes=described,
        **layout,
    )
    _consolidate(path)


def _codecs(itemsize: int) -> list[Any]:
    """Compression with a checksum: Blosc alone reads most flipped bits as wrong numbers."""
    return [BloscCodec(cname="zstd", clevel=1, shuffle="shuffle", typesize=itemsize), Crc32cCodec()]


def _write_coordinates(group: zarr.Group, grid: Grid, dim: str) -> list[str]:
    """Write what varies along a dimension, piece by piece; returns the names that are no index."""
    piece, length = 1_000_000, grid.dims[dim]
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
                    attributes={"units": about["unit"], "long_name": about["meaning"]},
                )
            array = group[name]
            assert isinstance(array, zarr.Array)
            array[part] = values
    return [name for name in grid.coordinates(dim, slice(0, 1)) if name != dim]


def _consolidate(path: Path) -> None:
    """One file with all metadata: xarray opens it without a warning, and faster."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata")  # zarr: not in the v3 standard
        zarr.consolidate_metadata(path)


def dataset(path: Path) -> "xr.Dataset":
    """The store as a lazy Dataset. Raises SweepError if it is none."""
    import xarray as xr  # half a second with pandas, and a run needs neither

    open_store(path, "r")  # tells a foreign one
    return xr.open_zarr(path, chunks=None)
