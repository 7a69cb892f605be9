"""The result store: one Zarr directory that `xarray.open_zarr` reads with no code of ours.

Block = chunk = unit of commit. A block's metrics are written first and its `status` last, each
file by a rename, so that a block counts as done when, and only when, its status says so.
"""

import hashlib
import os
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr

from fic_jax import Metrics, trusted
from sweeps.grid import Block, Grid
from sweeps.spec import STORED, Sweep, SweepError

if TYPE_CHECKING:
    import xarray as xr

NOT_RUN, OK, DIVERGED, FAILED = range(4)
STATUS = {"not run": NOT_RUN, "ok": OK, "diverged": DIVERGED, "failed": FAILED}
NO_ESTIMATE, NOT_TRUSTED, TRUSTED = range(3)
TRUSTWORTHY = {"no estimate": NO_ESTIMATE, "not trusted": NOT_TRUSTED, "trusted": TRUSTED}
FLAGS = {"trusted": TRUSTWORTHY, "status": STATUS}  # beside the metrics; 0 is the fill value
ERRORS = {f"{name}_error": name for name in STORED}  # estimate -> the metric it is about
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

    def trusted(self) -> tuple[int, float] | None:
        """Cells done that are trusted, and the bound; None for a store without estimates."""
        if not self.grid.sweep.error_estimate:
            return None
        flags, status, total = self._array("trusted"), self._array("status"), 0
        for block in self.grid.blocks():  # status too: an interrupted block is not done
            done = np.asarray(status[block]) != NOT_RUN
            total += int(np.sum(done & (np.asarray(flags[block]) == TRUSTED)))
        return total, float(str(self.group.attrs["trust_bound"]))

    def write(self, block: Block, metrics: Metrics, errors: Metrics | None = None) -> int:
        """Commit one block; returns how many of its scenarios diverged.

        A diverged scenario keeps no metrics: its cells are NaN and its status says why.
        """
        names, finite = self.grid.sweep.metrics, metrics.finite
        for name in names:
            self._put(name, block, np.where(finite, getattr(metrics, name), np.nan))
        if errors is not None:
            for name in names:
                self._put(f"{name}_error", block, np.where(finite, getattr(errors, name), np.nan))
            flags = np.where(trusted(metrics, errors), TRUSTED, NOT_TRUSTED)
            self._put("trusted", block, np.where(finite, flags, NO_ESTIMATE))
        self._put("status", block, np.where(finite, OK, DIVERGED))
        return int((~finite).sum())

    def note(self, **attributes: str) -> None:
        """Add attributes, visible to whoever opens the store next."""
        self.group.attrs.update(attributes)
        consolidate(self.path)

    def _put(self, name: str, block: Block, values: np.ndarray) -> None:
        array = self._array(name)
        shape = tuple(part.stop - part.start for part in block)
        array[block] = values.reshape(shape).astype(array.dtype)

    @cached_property
    def _arrays(self) -> dict[str, zarr.Array[Any]]:
        return dict(self.group.arrays())

    def _array(self, name: str) -> zarr.Array[Any]:
        return self._arrays[name]


def open_store(path: Path, mode: Any = "r+") -> Store:
    """Open a store and rebuild its plan. Raises SweepError if it is none or was tampered with."""
    if not os.path.isfile(path / "zarr.json"):  # False, too, for a name no file may have
        raise SweepError(f"{path}: is no result store (no zarr.json in it)")
    try:
        group = zarr.open_group(path, mode=mode)
        attributes = group.attrs.asdict()
        record = str(attributes["sweep"])
        estimated = bool(attributes.get("error_estimate"))  # older stores don't say
        sweep = Sweep.model_validate_json(record).model_copy(update={"error_estimate": estimated})
        chunk, written = int(str(attributes["block_cells"])), attributes["sweep_sha256"]
        written_format = attributes["format"]
    except (KeyError, ValueError, OSError) as error:
        raise SweepError(f"{path}: is no result store of fic-sweep ({error})"[:200]) from None
    if written_format != FORMAT:
        raise SweepError(f"{path}: has format {written_format}; this program reads {FORMAT}")
    if sha256(record) != written:
        raise SweepError(f"{path}: its sweep record differs from the one that began it")
    return Store(path, Grid(sweep, chunk), group)


def variable_names(sweep: Sweep) -> list[str]:
    """What a store holds of every cell, in the order it is written."""
    estimates = [*(f"{name}_error" for name in sweep.metrics), "trusted"]
    return [*sweep.metrics, *(estimates if sweep.error_estimate else ()), "status"]


def sha256(record: str) -> str:
    """What a sweep record is recognised by: its text, so that later fields change nothing."""
    return hashlib.sha256(record.encode()).hexdigest()


def consolidate(path: Path) -> None:
    """One file with all metadata: xarray opens it without a warning, and faster."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata")  # zarr: not in the v3 standard
        zarr.consolidate_metadata(path)


def dataset(path: Path) -> "xr.Dataset":
    """The store as a lazy Dataset, its variables in order. Raises SweepError if it is none."""
    import xarray as xr  # half a second with pandas, and a run needs neither

    sweep = open_store(path, "r").grid.sweep  # tells a foreign one
    return xr.open_zarr(path, chunks=None)[variable_names(sweep)]
