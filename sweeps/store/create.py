"""Make an empty store: whole, or not at all."""

import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import zarr

from sweeps import disk
from sweeps.plan.grid import Grid
from sweeps.spec.mistakes import SweepError, command, printable
from sweeps.spec.types import Sweep
from sweeps.store import format as store_format
from sweeps.store.fsync import PARTIAL, sync, sync_tree
from sweeps.store.ledger import LEDGER, Ledger, LedgerError
from sweeps.store.lock import LOCK, locked
from sweeps.store.opening import Store, open_store
from sweeps.store.place import before_extension, place_of_new, store_around


def create(path: Path, grid: Grid, made_by: Mapping[str, Any]) -> Store:
    """Make an empty store, with `made_by` among its attributes. Raises SweepError if it can't."""

    def write(partial: Path) -> None:
        write_empty(partial, grid, made_by)
        sync_tree(partial)

    return build(check_new(path, grid, made_by["dtype"]), write)


def build(path: Path, write: Callable[[Path], None]) -> Store:
    """Make a store of what `write` puts on the disk, in the folder that it gets.

    Raises SweepError if it can't be made, OSError if the disk refuses.
    """
    partial, parent = partial_of(path), _existing_parent(path)
    try:
        with building(partial):
            write(partial)
            refuse_existing(path)
            partial.rename(path)
            sync(path.parent)
        for folder in path.absolute().parents:  # a power cut must not lose the new folders either
            if folder.is_relative_to(parent) and folder != path.absolute().parent:
                sync(folder)
    except (OSError, LedgerError) as error:
        _remove_new_folders(path, parent)
        reason = getattr(error, "strerror", None) or error
        if disk.refused(error):
            raise OSError(
                getattr(error, "errno", 0), f"can't be written: {reason}", str(path)
            ) from None
        raise SweepError(f"{path}: can't be written: {reason}") from None
    return open_store(path)


@contextmanager
def taken_back_if_refused(path: Path) -> Iterator[None]:
    """Delete a store that is made at `path` inside, if its run is refused before a block is done.

    A store that was there before stays. Reraises the SweepError.
    """
    before, parent = os.path.lexists(path), _existing_parent(path)
    try:
        yield
    except SweepError:
        if not before and (path / "zarr.json").is_file():
            with suppress(SweepError, OSError), locked(path):  # by no other process
                if not open_store(path).rows():
                    shutil.rmtree(path)
                    _remove_new_folders(path, parent)
        raise


def _remove_new_folders(path: Path, parent: Path) -> None:
    """Remove the empty folders around `path` that are below `parent`."""
    for folder in path.absolute().parents:
        if folder.is_relative_to(parent) and folder != parent:
            with suppress(OSError):  # not made, or another process uses it
                folder.rmdir()


def check_new(path: Path, grid: Grid, dtype: str) -> Path:
    """The place of a store that is to be made. Raises SweepError if it can't be made there."""
    path = place_of_new(path)
    refuse_existing(path, grid.sweep)
    refuse_small_disk(path, grid, dtype)
    return path


def refuse_existing(path: Path, wanted: Sweep | None = None) -> None:
    """Raise SweepError if a new store, of the sweep `wanted`, would replace something."""
    if outer := store_around(path):
        raise SweepError(f"{path}: lies in the store {outer}; --out names another place")
    if path.exists() or path.is_symlink():
        there, resume = "", ""
        with suppress(SweepError):  # it is something else
            there = _another(open_store(path).grid.sweep, wanted)
            resume = "" if there else f"{command('resume', path)} continues it, "
        raise SweepError(f"{path}: exists already{there}; {resume}--out names another")
    if os.path.lexists(before_extension(path)):  # `recover` would delete it
        resume = f"{command('resume', path)} finishes its extension, which was cut short"
        raise SweepError(f"{path}: {resume}; --out names another")


def _another(found: Sweep, wanted: Sweep | None) -> str:
    """What a store has, if that is not what is wanted of a new one."""
    if wanted is None or found.record() == wanted.record():
        return ""
    if found.reduce and found.reduce != wanted.reduce:
        return f", with another answer, {printable(found.reduce.question)}"
    return f", and has another sweep, {found.name}"


def partial_of(path: Path) -> Path:
    """Where a store is built, before it gets its name."""
    return path.with_name(f".{path.name}{PARTIAL}")


def refuse_small_disk(path: Path, grid: Grid, dtype: str) -> None:
    """Raise SweepError if the disk has no room for a store."""
    needed, parent = store_format.size(grid, dtype), _existing_parent(path)
    free = shutil.disk_usage(parent).free
    if needed > free:
        raise SweepError(
            f"{path}: the sweep needs up to {needed / 1e9:.3g} GB for {grid.own_cells:,} cells, "
            f"but {parent} has {free / 1e9:.3g} GB free"
        )


@contextmanager
def building(partial: Path) -> Iterator[None]:
    """A locked, empty folder to build a store in; deleted at the end if it still has that name.

    Raises SweepError if another process builds in it.
    """
    partial.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        try:
            held.enter_context(locked(partial))
        except OSError:  # not locked by another process: that is a SweepError
            shutil.rmtree(partial, ignore_errors=True)
            raise
        try:
            for entry in partial.iterdir():  # from a killed process
                if entry.is_dir() and not entry.is_symlink():
                    shutil.rmtree(entry)
                elif entry.name != LOCK:
                    entry.unlink()
            yield
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def write_empty(
    path: Path, grid: Grid, made_by: Mapping[str, Any], form: int = store_format.FORMAT
) -> None:
    """Write attributes, coordinates, the metadata of each variable, and an empty ledger."""
    group = zarr.create_group(path, attributes=store_format.attributes(grid) | dict(made_by))
    for array in store_format.arrays(grid, made_by["dtype"], form):
        group.create_array(**array)
    beside = [name for dim in grid.dims for name in _write_coordinates(group, grid, dim)]
    if beside:
        group.attrs.update({"coordinates": " ".join(beside)})
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata")  # zarr: not in the v3 standard
        warnings.filterwarnings("ignore", f"Object at {LOCK}")  # of this process
        zarr.consolidate_metadata(path)  # all metadata in one file: xarray opens it faster
    ledger = Ledger.create(path / LEDGER)
    files = [path / "zarr.json", *sorted(p for p in path.glob("*/*") if p.is_file())]
    ledger.insert_metadata((f.relative_to(path).as_posix(), f.read_bytes()) for f in files)


def _write_coordinates(group: zarr.Group, grid: Grid, dim: str) -> list[str]:
    """Write what varies along a dimension; returns the names that differ from the dimension's."""
    piece, length = store_format.COORDINATE_CHUNK, grid.dims[dim]
    for start in range(0, length, piece):
        part = slice(start, min(start + piece, length))
        for name, values in grid.coordinates(dim, part).items():
            array = group[name]
            assert isinstance(array, zarr.Array)
            array[part] = values
    return [name for name in grid.coordinates(dim, slice(0, 1)) if name != dim]


def _existing_parent(path: Path) -> Path:
    return next(folder for folder in path.absolute().parents if folder.exists())
