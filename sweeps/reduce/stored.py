"""A reduced store from the cells of another store: what a run of the reduced sweep would make."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sweeps.plan.grid import Block, Grid
from sweeps.reduce.fold import block_values, variables_read
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import validate
from sweeps.spec.types import Sweep
from sweeps.store.commit import Values, now, writing
from sweeps.store.create import create
from sweeps.store.format import attributes
from sweeps.store.ledger import DONE, Row, intact
from sweeps.store.opening import Counts, Store


def reduced_sweep(store: Store, reduce: dict[str, Any]) -> Sweep:
    """The sweep of a store with a table `[reduce]`. Raises SweepError for a mistake in it."""
    sweep = store.grid.sweep
    if sweep.reduce:
        raise SweepError(f"{store.path}: is reduced already; reduce the store with all its cells")
    if sweep.refine:
        why = "most of its cells were not simulated, and would count as if they had been"
        raise SweepError(f"{store.path}: is refined: {why}; reduce a store with all its cells")
    store.check_definition()
    precision = int(store.dtype.removeprefix("float"))
    raw = json.loads(sweep.record())
    raw |= {"error_estimate": sweep.error_estimate, "precision": precision, "reduce": reduce}
    return validate(raw, str(store.path))


def reduce_store(
    store: Store, sweep: Sweep, path: Path, chunk: int | None, on_block: Callable[[int, int], None]
) -> Store:
    """Make the store of a reduced sweep at `path`, from the cells of `store`.

    The new store names the program that computed the cells. `on_block` is called after each block
    with the number of blocks that are done, and that there are. If it is interrupted, `resume`
    computes the rest. Raises SweepError if it can't be made or a file of a finished block is not as
    written.
    """
    if not Counts.of(store).done:
        raise SweepError(f"{store.path}: has no finished block, so there is nothing to reduce")
    store.check_metadata()
    store.check_files()
    of_sweep = {*attributes(store.grid), "coordinates", "end", "extended", "start"}
    made_by = {k: v for k, v in store.group.attrs.asdict().items() if k not in of_sweep}
    made_by |= {"start": now(), "reduced_from": store.path.name}
    new = create(path, Grid(sweep, chunk), made_by)
    read = _reading(store, variables_read(sweep))
    with writing(new) as (writer, _):
        for index in range(new.grid.n_blocks):
            values = block_values(new.grid, new.grid.block(index), read)
            writer.commit(values, Row(index, DONE))
            on_block(index + 1, new.grid.n_blocks)
        writer.end()
    return new


def _reading(store: Store, names: list[str]) -> Callable[[Block], Values]:
    """Reads boxes of some variables; each file is compared with its checksum once."""
    rows, checked = {row.block: row for row in store.rows()}, set[int]()

    def read(box: Block) -> Values:
        for index in (i for i in _blocks(store.grid, box) if i in rows and i not in checked):
            files = rows[index].files
            if not all(intact(store.file(name, index), files[name]) for name in names):
                raise store.damaged(f"block {index} is not as it was written")
            checked.add(index)
        return {name: np.asarray(store.array(name)[box]).ravel() for name in names}

    return read


def _blocks(grid: Grid, box: Block) -> Iterator[int]:
    """The blocks that have a cell of a box."""
    sides = [
        np.arange(part.start // side, (part.stop - 1) // side + 1)
        for part, side in zip(box, grid.block_shape, strict=True)
    ]
    return iter(np.ravel_multi_index(np.ix_(*sides), grid.counts).ravel().tolist())
