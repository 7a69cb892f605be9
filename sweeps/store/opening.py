"""The result store: one Zarr directory that `xarray.open_zarr` reads with no code of ours.

Block = chunk = unit of commit. A block is done when, and only when, the ledger beside the arrays
has a row for it (`sweeps.store.commit` writes them, in that order).
"""

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import zarr

from sweeps.plan.grid import Grid
from sweeps.spec.mistakes import SweepError, printable
from sweeps.spec.reading import validate
from sweeps.spec.types import STORED, Sweep
from sweeps.store import ledger as ledgers
from sweeps.store.fsync import PARTIAL
from sweeps.store.ledger import DONE, SET_ASIDE, Fixed, Ledger, LedgerError, Row, intact

if TYPE_CHECKING:
    import xarray as xr

NOT_RUN, OK, DIVERGED, FAILED = range(4)
STATUS = {"not run": NOT_RUN, "ok": OK, "diverged": DIVERGED, "failed": FAILED}
NO_ESTIMATE, NOT_TRUSTED, TRUSTED = range(3)
TRUSTWORTHY = {"no estimate": NO_ESTIMATE, "not trusted": NOT_TRUSTED, "trusted": TRUSTED}
FLAGS = {"trusted": TRUSTWORTHY, "status": STATUS}  # beside the metrics; 0 is the fill value
ERRORS = {f"{name}_error": name for name in STORED}  # estimate -> the metric it is about
FORMAT = 2  # of the store; a change that older programs can't read adds one
COORDINATE_CHUNK = 1_000_000  # values of a coordinate that are written at once
LARGEST_RECORD = 20_000_000  # bytes of a store's zarr.json: a sweep file's million, escaped


@dataclass(frozen=True)
class Store:
    """An open store: where it is, its plan, its arrays, its ledger."""

    path: Path
    grid: Grid
    group: zarr.Group
    ledger: Ledger | None  # none in format 1

    @property
    def dtype(self) -> str:
        """Precision of the metrics, `float32` or `float64`."""
        return str(self.group.attrs["dtype"])

    def rows(self) -> list[Row]:
        """What is known of each block that was worked on. Raises SweepError."""
        if self.ledger is None:
            return list(self._scanned())
        if not self.ledger.path.is_file():
            raise self.damaged(f"{ledgers.NAME} is missing")
        try:
            rows = list(self.ledger.rows())
        except LedgerError as error:
            raise self.damaged(f"{ledgers.NAME} is damaged: {error}") from None
        for row in rows:
            if not 0 <= row.block < self.grid.n_blocks or set(row.files) - set(self.variables):
                raise self.damaged(f"{ledgers.NAME} is damaged: it has a block {row.block}")
        return rows

    def damaged(self, what: str) -> SweepError:
        """The error for a store that isn't as it was written."""
        return SweepError(f"{self.path}: {what}; `fic-sweep verify {self.path} --repair` mends it")

    @cached_property
    def variables(self) -> list[str]:
        """What is stored of every cell."""
        return variable_names(self.grid.sweep)

    def file(self, variable: str, index: int) -> Path:
        """Where a block of a variable is."""
        return self.path / variable / ".".join(["c", *map(str, self.grid.place(index))])

    def refuse_missing(self) -> None:
        """Raise SweepError where files of finished blocks are gone: Zarr would read fill values.

        Also where one is of another size: somebody else's could fill the memory.
        """
        if self.ledger is None:
            return
        rows = self.rows()
        # status first: it is written last, perhaps while this looks
        there = {name: _files(self.path / name) for name in reversed(self.variables)}
        files = ((self.file(n, row.block), stamp) for row in rows for n, stamp in row.files.items())
        missing = [f for f, stamp in files if there[f.parent.name].pop(f.name, -1) != stamp.size]
        if missing:
            first = missing[0].relative_to(self.path)
            more = f" and {len(missing) - 1:,} more files" if len(missing) > 1 else ""
            raise self.damaged(f"lacks {first}{more}, of finished blocks")
        left = there["status"].keys()  # of blocks under way
        if not all(left <= files.keys() for files in there.values()):
            told = "a power cut left blocks half written"
            raise SweepError(f"{self.path}: {told}; `fic-sweep resume {self.path}` writes them")

    def check_frame(self) -> None:
        """Raise SweepError where metadata or coordinates are not as they were written."""
        if self.ledger is None:
            return
        try:
            fixed = list(self.ledger.fixed())
        except LedgerError as error:
            raise self.damaged(f"{ledgers.NAME}: {error}") from None
        for one in fixed:
            if not as_written(self.path, one):
                raise self.damaged(f"{one.path} is not as it was written")

    def array(self, name: str) -> zarr.Array[Any]:
        """A variable on disk."""
        return self._arrays[name]

    @cached_property
    def _arrays(self) -> dict[str, zarr.Array[Any]]:
        return dict(self.group.arrays())

    def _scanned(self) -> Iterator[Row]:
        """Rows of a store that has no ledger, from its status."""
        status = self.array("status")
        for index, block in enumerate(self.grid.blocks()):
            values = np.asarray(status[block])
            if np.all(values != NOT_RUN):
                _, ok, diverged, failed = np.bincount(
                    values.ravel(), minlength=len(STATUS)
                ).tolist()
                trusted = 0
                if self.grid.sweep.error_estimate:
                    trusted = int(np.sum(np.asarray(self.array("trusted")[block]) == TRUSTED))
                yield Row(index, DONE, ok, diverged, failed, trusted)


@dataclass(frozen=True)
class Tally:
    """How far a store is."""

    cells: dict[str, int]  # of each status
    trusted: int
    pending: list[int]  # blocks to run, in storage order
    set_aside: list[Row]
    begun: dict[int, Row]  # pending blocks of which the ledger knows something

    @property
    def done(self) -> int:
        """Cells that were computed; a failed one was not."""
        return self.cells["ok"] + self.cells["diverged"]

    @classmethod
    def of(cls, store: Store) -> "Tally":
        """Count the ledger of a store. Raises SweepError if it is damaged."""
        rows = store.rows()
        ok, diverged, failed = (sum(getattr(row, n) for row in rows) for n in list(STATUS)[OK:])
        not_run = store.grid.cells - ok - diverged - failed
        cells = dict(zip(STATUS, (not_run, ok, diverged, failed), strict=True))
        done = {row.block for row in rows if row.outcome == DONE}
        pending = [i for i in range(store.grid.n_blocks) if i not in done]
        aside = [row for row in rows if row.outcome == SET_ASIDE]
        begun = {row.block: row for row in rows if row.outcome != DONE}
        return cls(cells, sum(row.trusted for row in rows), pending, aside, begun)


def open_store(path: Path, mode: Any = "r") -> Store:
    """Open a store and rebuild its plan. Raises SweepError if it is none or was tampered with."""
    if not os.path.isfile(path / "zarr.json"):  # False, too, for a name no file may have
        raise SweepError(f"{path}: is no result store (no zarr.json in it)")
    try:
        if os.path.getsize(path / "zarr.json") > LARGEST_RECORD:
            raise ValueError("its zarr.json is too large")
        if "consolidated_metadata" not in json.loads((path / "zarr.json").read_bytes()):
            raise ValueError("its metadata is not in one file")  # Zarr would open any other
        group = zarr.open_group(path, mode=mode, zarr_format=3)
        attributes = group.attrs.asdict()
        record = str(attributes["sweep"])
        raw = json.loads(record)
        raw["error_estimate"] = bool(attributes.get("error_estimate"))  # older stores don't say
        chunk, written = int(str(attributes["block_cells"])), attributes["sweep_sha256"]
        written_format, dtype = attributes["format"], attributes["dtype"]
        if chunk < 1 or dtype not in ("float32", "float64"):
            raise ValueError(f"block_cells {chunk}, dtype {dtype}")
    except Exception as error:  # whatever zarr and pydantic make of somebody else's file
        told = printable(" ".join(str(error).split())[:150])
        raise SweepError(f"{path}: is no result store of fic-sweep ({told})") from None
    if written_format not in (1, FORMAT):
        raise SweepError(f"{path}: has format {written_format}; this program reads up to {FORMAT}")
    if sha256(record) != written:
        raise SweepError(f"{path}: its sweep record differs from the one that began it")
    ledger = Ledger(path / ledgers.NAME) if written_format > 1 else None
    store = Store(path, Grid(validate(raw, str(path)), chunk), group, ledger)
    for expected in _expected(store):
        if not _is(store, *expected):
            raise SweepError(f"{path}: its variable {expected[0]} is not the one of its sweep")
    if ledger is None and any(not plain(entry) for entry in path.rglob("*")):
        raise SweepError(f"{path}: has a link in it; a store is one folder")
    return store


def _expected(store: Store) -> Iterator[tuple[str, tuple[int, ...], tuple[int, ...], str]]:
    """Every array of a store: name, shape, shape of a chunk, and what its values are."""
    grid, chunk = store.grid, (COORDINATE_CHUNK,)
    for name in store.variables:
        yield name, grid.shape, grid.block_shape, "uint8" if name in FLAGS else store.dtype
    for dim, length in grid.dims.items():
        for name, value in grid.coordinates(dim, slice(0, 1)).items():
            dtype = "StringDType()" if value.dtype.kind == "U" else str(value.dtype)
            yield name, (length,), min((length,), chunk), dtype


def _is(
    store: Store, name: str, shape: tuple[int, ...], chunks: tuple[int, ...], dtype: str
) -> bool:
    """Whether an array is as we lay it out: somebody else's could ask for any memory or codec."""
    try:
        array = store.array(name)
        told = array.metadata.to_dict()["codecs"]
        codecs = {codec["name"] for codec in cast(Any, told)}
        return (
            (array.shape, array.chunks, str(array.dtype)) == (shape, chunks, dtype)
            and codecs <= {"bytes", "blosc", "crc32c", "vlen-utf8"}
            and not (store.path / name).is_symlink()
        )
    except Exception:  # whatever zarr makes of somebody else's metadata
        return False


def as_written(path: Path, one: Fixed) -> bool:
    """Whether a file outside the blocks is as it was written, but for what a kill may leave out.

    When a store is finished the ledger is told first and its zarr.json next.
    """
    place = path / one.path
    if intact(place, one.stamp):
        return True
    if one.path != "zarr.json" or one.content is None or not (plain(place) and place.is_file()):
        return False
    try:
        with place.open("rb") as file:  # not all of it: it may be any size
            noted, told = json.loads(one.content), json.loads(file.read(LARGEST_RECORD))
        return bool(noted["attributes"].pop("end")) and noted == told
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False


def plain(entry: Path) -> bool:
    """Whether this is a file or a folder, and no way to anything else."""
    return not entry.is_symlink() and (entry.is_file() or entry.is_dir())


def _files(folder: Path) -> dict[str, int]:
    """Size of each file in a folder. Raises SweepError where a reader would wait, or leave."""
    sizes = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if not entry.is_file(follow_symlinks=False):
                    raise SweepError(f"{entry.path}: is no file, as all of a store is")
                if not entry.name.endswith(PARTIAL):
                    sizes[entry.name] = entry.stat().st_size
    except OSError:  # gone, or going: a process may be at it
        return {}
    return sizes


def variable_names(sweep: Sweep) -> list[str]:
    """What a store holds of every cell, in the order it is written."""
    estimates = [*(f"{name}_error" for name in sweep.metrics), "trusted"]
    return [*sweep.metrics, *(estimates if sweep.error_estimate else ()), "status"]


def sha256(record: str) -> str:
    """What a sweep record is recognised by: its text, so that later fields change nothing."""
    return hashlib.sha256(record.encode()).hexdigest()


def dataset(path: Path) -> "xr.Dataset":
    """The store as a lazy Dataset, its variables in order. Raises SweepError if it is none."""
    import xarray as xr  # half a second with pandas, and a run needs neither

    store = open_store(path)  # tells a foreign one
    store.check_frame()
    store.refuse_missing()
    return xr.open_zarr(path, chunks=None)[store.variables]
