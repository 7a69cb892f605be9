"""How a block gets into a store, so that it is there whole or not at all.

1. each variable's chunk is encoded, 2. written and flushed under a name of its own, 3. renamed to
its place, 4. the folders are flushed, 5. a row with the checksum of each goes into the ledger.
Whatever ends the process or the power between two of these, the block is done or it is not.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property
from typing import Any

import numpy as np
import zarr
from zarr.core.buffer import Buffer
from zarr.storage import MemoryStore

from fic_jax import Metrics, trusted
from sweeps.plan.grid import Grid, cells_of, shape_of
from sweeps.spec.mistakes import SweepError
from sweeps.store import format as layout
from sweeps.store import fsync as durable
from sweeps.store import ledger as ledgers
from sweeps.store.ledger import Ledger, Row, Stamp, intact
from sweeps.store.lock import Owner, owning
from sweeps.store.opening import (
    DIVERGED,
    NO_ESTIMATE,
    NOT_RUN,
    NOT_TRUSTED,
    OK,
    STATUS,
    TRUSTED,
    Store,
    variable_names,
)

Values = dict[str, np.ndarray]  # of a block: variable -> [N], in storage order


class Writer:
    """What writes the blocks of a store that this process owns."""

    def __init__(self, store: Store) -> None:
        if store.ledger is None:
            raise SweepError(f"{store.path}: has format 1, without a ledger: it can only be read")
        self.store, self.ledger = store, store.ledger

    def commit(self, values: Values, row: Row) -> Row:
        """Write a block, then its row, with what is counted here; returns the row.

        Raises OSError; the block then has no row.
        """
        files = {name: self._encode(row.block, name, values[name]) for name in self.store.variables}
        # a row of a block done in part, or set aside, is about files that are now replaced
        self.ledger.forget([row.block])
        durable.write({self.store.file(name, row.block): files[name] for name in files})
        _, ok, diverged, failed = np.bincount(values["status"], minlength=len(STATUS)).tolist()
        row = replace(
            row,
            ok=ok,
            diverged=diverged,
            failed=failed,
            trusted=int(np.sum(values["trusted"] == TRUSTED)),
            at=now(),
            files={name: Stamp.of(content) for name, content in files.items()},
        )
        self.ledger.add([row])
        return row

    def ended(self) -> None:
        """Note when the store was finished, for whoever opens it next."""
        place = self.store.path / "zarr.json"
        content = json.loads(place.read_bytes())
        content["attributes"]["end"] = now()
        encoded = json.dumps(content, indent=2).encode()
        self.ledger.fix([("zarr.json", encoded)])  # first: `verify --repair` goes by the ledger
        durable.write({place: encoded})

    def _encode(self, index: int, name: str, values: np.ndarray) -> bytes:
        """A block of a variable as the bytes of its file."""
        block, array = self.store.grid.block(index), self._twins[name]
        array[block] = values.reshape(shape_of(block)).astype(array.dtype, copy=False)
        return self._memory.pop(f"{name}/{self.store.file(name, index).name}").to_bytes()

    @cached_property
    def _memory(self) -> dict[str, Buffer]:
        return {}

    @cached_property
    def _twins(self) -> dict[str, zarr.Array[Any]]:
        """The variables once more, in memory: zarr encodes, and writing is ours."""
        grid, dtype, memory = self.store.grid, self.store.dtype, MemoryStore(self._memory)
        return {
            name: zarr.create_array(memory, **layout.variable(grid, name, dtype))
            for name in self.store.variables
        }


def values_of(metrics: Metrics, errors: Metrics | None) -> Values:
    """What is stored of scenarios: a diverged one keeps no metrics, and its status says why."""
    finite = metrics.finite
    values = _without(~finite, metrics)
    values["trusted"] = np.full(finite.shape, NO_ESTIMATE)
    if errors is not None:
        values |= {f"{name}_error": v for name, v in _without(~finite, errors).items()}
        flags = np.where(trusted(metrics, errors), TRUSTED, NOT_TRUSTED)
        values["trusted"] = np.where(finite, flags, NO_ESTIMATE)
    return values | {"status": np.where(finite, OK, DIVERGED)}


def _without(diverged: np.ndarray, metrics: Metrics) -> Values:
    """Metrics with NaN for the diverged; few blocks have any, and copies take their time."""
    values = vars(metrics)
    if not diverged.any():
        return dict(values)
    return {name: np.where(diverged, np.nan, value) for name, value in values.items()}


def no_values(grid: Grid, index: int) -> Values:
    """A block of which nothing is known."""
    n = cells_of(grid.block(index))
    flags = {"status": np.full(n, NOT_RUN), "trusted": np.full(n, NO_ESTIMATE)}
    return {name: np.full(n, np.nan) for name in variable_names(grid.sweep)} | flags


def kept(store: Store, row: Row) -> Values | None:
    """The numbers of a block as they were committed; None if its files are not as written."""
    if not all(intact(store.file(name, row.block), stamp) for name, stamp in row.files.items()):
        return None
    block, values = store.grid.block(row.block), no_values(store.grid, row.block)
    stored = {name: np.asarray(store.array(name)[block]).ravel() for name in store.variables}
    return values | stored


@contextmanager
def changing(store: Store) -> Iterator[tuple[Writer, Owner]]:
    """Own a store and clear away what a killed process left. Raises SweepError, OSError."""
    writer = Writer(store)
    for name in (*store.variables, ledgers.NAME):
        if (store.path / name).is_symlink():  # somebody else's store could write elsewhere
            raise SweepError(f"{store.path}: its {name} is a link; a store is one folder")
    with owning(store.path) as owner:
        found = zarr.open_group(store.path, mode="r").attrs
        if any(found[key] != store.group.attrs[key] for key in ("sweep", "block_cells")):
            raise SweepError(f"{store.path}: was changed by another process; try again")
        store.check_frame()
        (store.path / ledgers.SEAL).unlink(missing_ok=True)
        # through no link: somebody else's store could have files removed elsewhere
        inside = (p for p in store.path.iterdir() if p.is_dir() and not p.is_symlink())
        for folder in (store.path, *inside):
            for left in folder.glob(f"*{durable.PARTIAL}"):
                left.unlink()
        durable.sync(store.path)
        try:
            yield writer, owner
        finally:
            with suppress(OSError):  # it is about bytes that no row uses; the rows have their own
                seal(writer.ledger)


def now() -> str:
    """The time of a note."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def seal(ledger: Ledger) -> None:
    """Fix the whole ledger by a checksum, as long as nobody writes it. Raises OSError."""
    durable.write({ledger.path.with_name(ledgers.SEAL): ledger.sealed()})
