"""Write one block, so that it is in the store whole or not at all (the order: `sweeps.store`)."""

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
import zarr
from zarr.core.buffer import Buffer
from zarr.storage import MemoryStore

from fic_jax import Metrics, trusted
from sweeps.plan.grid import Grid, cells_of, shape_of
from sweeps.spec.mistakes import SweepError
from sweeps.store import format as store_format
from sweeps.store import fsync
from sweeps.store.format import (
    DEFINITION,
    DIVERGED,
    FORMAT,
    NO_ESTIMATE,
    NOT_TRUSTED,
    OK,
    STATUS,
    TRUSTED,
)
from sweeps.store.ledger import CHECKSUM, LEDGER, Checksum, Ledger, Row, intact
from sweeps.store.lock import Lock, locked
from sweeps.store.opening import Store

Values = dict[str, np.ndarray]  # of a block: variable -> [N], in storage order


class Writer:
    """Writes blocks into a store that this process has locked."""

    def __init__(self, store: Store) -> None:
        if store.ledger is None or (store.form, store.definition) != (FORMAT, DEFINITION):
            raise SweepError(f"{store.path}: has format {store.form}, which can only be read")
        self.store, self.ledger = store, store.ledger

    def commit(self, values: Values, row: Row) -> Row:
        """Write a block's files, then its row with counts and checksums; returns the row.

        Raises OSError; the block then has no row.
        """
        row = self.stage(values, row)
        self.publish(row)
        return row

    def stage(self, values: Values, row: Row, suffix: str = fsync.PARTIAL) -> Row:
        """Write a block's files under partial names; returns the row that will describe them.

        It changes no finished block, and needs no lock if no other process has this `suffix`.
        Raises OSError.
        """
        files = {name: self._encode(row.block, name, values[name]) for name in self.store.variables}
        fsync.stage({self.store.file(name, row.block): files[name] for name in files}, suffix)
        status = values["status"]
        cells = np.bincount(status, minlength=len(STATUS))
        _, ok, diverged, failed = cells[: len(STATUS)].tolist()
        return replace(
            row,
            ok=ok,
            diverged=diverged,
            failed=failed,
            trusted={
                metric: int(np.sum((values[flag] == TRUSTED) & (status == OK)))
                for flag, metric in store_format.judgements(self.store.grid.sweep).items()
            },
            at=now(),
            files={name: Checksum.of(content) for name, content in files.items()},
        )

    def publish(self, row: Row, suffix: str = fsync.PARTIAL) -> None:
        """Give a block's staged files their names, and insert its row. Raises OSError."""
        # The old row of a block that is done in part, or set aside, describes the old files.
        paths = [path for path, _ in self.store.files(row)]
        with fsync.deleted_after_error([path.with_name(path.name + suffix) for path in paths]):
            self.ledger.delete([row.block])
        fsync.publish(paths, suffix)
        self.ledger.insert([row])

    def end(self, **attributes: int) -> None:
        """Write the time at which the store was finished, and `attributes`, into its attributes."""
        path = self.store.path / "zarr.json"
        content = json.loads(path.read_bytes())
        content["attributes"] |= {"end": now()} | attributes
        encoded = json.dumps(content, indent=2).encode()
        # the ledger first: `verify --repair` restores what the ledger has
        self.ledger.insert_metadata([("zarr.json", encoded)])
        fsync.write({path: encoded})

    def _encode(self, index: int, name: str, values: np.ndarray) -> bytes:
        """The content of a block's file."""
        block, array = self.store.grid.block(index), self._arrays[name]
        array[block] = values.reshape(shape_of(block)).astype(array.dtype, copy=False)
        return self._memory.pop(f"{name}/{self.store.file(name, index).name}").to_bytes()

    @cached_property
    def _memory(self) -> dict[str, Buffer]:
        return {}

    @cached_property
    def _arrays(self) -> dict[str, zarr.Array[Any]]:
        """The variables in memory: Zarr encodes there, and `fsync.write` writes."""
        grid, dtype, memory = self.store.grid, self.store.dtype, MemoryStore(self._memory)
        return {
            name: zarr.create_array(memory, **store_format.variable(grid, name, dtype))
            for name in self.store.variables
        }


def values_of(metrics: Metrics, errors: Metrics | None, t_end: float) -> Values:
    """The variables of computed scenarios of `t_end` seconds. A diverged one has NaN metrics."""
    finite, values = np.asarray(metrics.finite), dict(vars(metrics))
    flags = {"status": np.where(finite, OK, DIVERGED)}
    if errors is not None:
        values |= {f"{name}_error": value for name, value in vars(errors).items()}
        with jax.default_device(_host()):  # a GPU would get all values, to send a bit of each back
            judged = trusted(metrics, errors, t_end)
        for name, within in vars(judged).items():
            trust = np.where(within, np.uint8(TRUSTED), np.uint8(NOT_TRUSTED))
            flags[f"{name}_trusted"] = np.where(finite, trust, np.uint8(NO_ESTIMATE))
    if not finite.all():  # in few blocks: copies take time
        values = {name: np.where(finite, value, np.nan) for name, value in values.items()}
    return values | flags


def _host() -> jax.Device | None:
    """JAX's CPU, or None where JAX_PLATFORMS leaves it out."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


def no_values(grid: Grid, index: int) -> Values:
    """The variables of a block that was not run."""
    n, sweep = cells_of(grid.block(index)), grid.sweep
    # the flags say "not run" and "no estimate"
    fills = {
        name: store_format.fill_value(sweep, name) for name in store_format.variable_names(sweep)
    }
    return {name: np.full(n, fill) for name, fill in fills.items()}


def read_block(store: Store, row: Row) -> Values | None:
    """The variables of a committed block; None if a file changed since."""
    if not all(intact(*file) for file in store.files(row)):
        return None
    block = store.grid.block(row.block)
    return {name: np.asarray(store.array(name)[block]).ravel() for name in store.variables}


@contextmanager
def writing(store: Store) -> Iterator[tuple[Writer, Lock]]:
    """Lock a store and delete what a killed process left. Raises SweepError, OSError."""
    writer = Writer(store)
    for name in (*store.variables, LEDGER):
        if (store.path / name).is_symlink():  # we would write outside the store
            raise SweepError(f"{store.path}: its {name} is a link; a store is one folder")
    with locked(store.path) as lock:
        found = zarr.open_group(store.path, mode="r").attrs
        if any(found[key] != store.group.attrs[key] for key in ("sweep", "block_cells")):
            raise SweepError(f"{store.path}: was changed by another process; try again")
        store.check_metadata()
        (store.path / CHECKSUM).unlink(missing_ok=True)  # from now on it is out of date
        delete_partials(store.path)
        fsync.sync(store.path)
        try:
            yield writer, lock
        finally:
            with suppress(OSError):  # rows have checksums of their own
                write_checksum(writer.ledger)


def delete_partials(path: Path) -> None:
    """Delete what killed processes left of unfinished files in a store. Raises OSError."""
    # through no link: we would delete files outside the store
    folders = (p for p in path.iterdir() if p.is_dir() and not p.is_symlink())
    for folder in (path, *folders):
        for partial in folder.glob(f"*{fsync.PARTIAL}"):
            if partial.is_symlink() or not partial.is_dir():  # a folder is not ours
                partial.unlink(missing_ok=True)


def write_checksum(ledger: Ledger) -> None:
    """Write the checksum of the whole ledger beside it. Raises OSError."""
    fsync.write({ledger.path.with_name(CHECKSUM): ledger.checksum()})


def now() -> str:
    """The time, as stores have it."""
    return datetime.now(UTC).isoformat(timespec="seconds")
