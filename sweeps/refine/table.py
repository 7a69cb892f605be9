"""The values of the cells that were simulated, wherever they are in the grid."""

from dataclasses import dataclass, field

import numpy as np

from sweeps.plan.grid import Grid
from sweeps.refine.boxes import Boxes
from sweeps.store.commit import Values, read_block
from sweeps.store.format import DIVERGED, DIVERGED_NEAR, LEVEL, OK, OK_NEAR
from sweeps.store.ledger import DONE
from sweeps.store.opening import Store

NONE = -1  # the row of a cell that was not simulated


@dataclass
class Table:
    """One row for each simulated cell; `row` says which."""

    grid: Grid
    n: int = 0
    columns: dict[str, list[np.ndarray]] = field(default_factory=dict)  # in pieces
    row: np.ndarray = field(init=False)  # [cells]

    def __post_init__(self) -> None:
        self.row = np.full(self.grid.cells, NONE, np.int32)

    def add(self, cells: np.ndarray, values: Values) -> None:
        """Add cells with their values."""
        self.row[cells] = np.arange(self.n, self.n + len(cells), dtype=np.int32)
        for name, column in values.items():
            self.columns.setdefault(name, []).append(column)
        self.n += len(cells)

    def values(self, name: str, cells: np.ndarray) -> np.ndarray:
        """A variable in cells that were simulated."""
        pieces = self.columns[name]
        if len(pieces) > 1:
            pieces[:] = [np.concatenate(pieces)]
        return pieces[0][self.row[cells]]

    def read(self, store: Store) -> None:
        """Add what a store has: in its journal, and in the blocks that are done."""
        for cells, values in store.journal.read():
            self._add_new(cells, values)
        for known in store.rows():
            block = read_block(store, known) if known.outcome == DONE else None
            if block is not None:
                there = np.isin(block["status"], (OK, DIVERGED))
                cells = self.grid.cells_in(known.block)[there]
                self._add_new(cells, {k: v[there] for k, v in block.items() if k != LEVEL})

    def _add_new(self, cells: np.ndarray, values: Values) -> None:
        new = self.row[cells] == NONE
        self.add(cells[new], {name: column[new] for name, column in values.items()})

    def done(self, block: int, boxes: Boxes) -> Values:
        """The variables of a block in which each cell has a value, its own or the nearest."""
        level, nearest = boxes.around(self.grid.block(block))
        cells = self.grid.cells_in(block)
        own = self.row[cells] != NONE
        source = np.where(own, cells, nearest.ravel())
        values = {name: self.values(name, source) for name in self.columns}
        near = np.where(values["status"] == OK, OK_NEAR, DIVERGED_NEAR)
        values["status"] = np.where(own, values["status"], near).astype(np.uint8)
        values[LEVEL] = level.ravel()
        return values
