"""The rounds of a refined run: choose boxes, simulate their cells, write blocks."""

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from fic_jax import TRUST
from sweeps.plan.grid import Grid
from sweeps.refine.boxes import Boxes, Measure
from sweeps.refine.table import NONE, Table
from sweeps.spec.condition import holds, names
from sweeps.store.commit import Values, Writer, no_values
from sweeps.store.format import DIVERGED, FAILED
from sweeps.store.ledger import DONE, SET_ASIDE, Row

Simulate = Callable[[np.ndarray], Values]  # cells of one model, at most a block of them

ATTEMPTS = 3  # at some cells before their blocks are set aside
# Values wait in memory until so many seconds went into them, or this many times what it took to
# write the last ones: a kill costs no more, and writing takes at most a tenth of the time.
WAIT, SHARE = 2.0, 10
NO_CLASS, DIVERGES = 255, 128  # beyond the 2^7 classes that conditions make


@dataclass(frozen=True)
class Step:
    """How far a refined run is."""

    simulated: int  # cells in all
    ran: int = 0  # by this run
    diverged: int = 0  # of these
    blocks: int = 0  # written by this run, after all simulations
    ended: bool = False  # the last one is written
    left: int | None = None  # level of the first box that the budget did not suffice for
    rows: tuple[Row, ...] = ()  # of blocks that were just set aside


@dataclass
class _Known:
    """What the choice of boxes may use: the cells of all rounds so far, no others.

    The store may have more: what an interrupted run has simulated of later rounds.
    """

    grid: Grid
    table: Table
    dtype: str  # of the metrics
    cells: np.ndarray = field(init=False)  # bool [cells]
    classes: np.ndarray = field(init=False)  # [cells]
    metrics: dict[str, np.ndarray] = field(init=False)  # metric with a tolerance -> [cells]

    def __post_init__(self) -> None:
        refine = self.grid.sweep.refine
        assert refine
        self.cells = np.zeros(self.grid.cells, bool)
        self.classes = np.full(self.grid.cells, NO_CLASS, np.uint8)
        self.metrics = {
            name: np.full(self.grid.cells, np.nan, self.dtype)
            for name in (*refine.absolute, *refine.relative)
        }

    @property
    def n(self) -> int:
        return int(self.cells.sum())

    def add(self, cells: np.ndarray) -> None:
        """Add cells, which the table has."""
        refine = self.grid.sweep.refine
        assert refine
        self.cells[cells] = True
        found = np.zeros(len(cells), np.uint8)
        for bit, text in enumerate(refine.classes):
            named = {name: self.table.values(name, cells) for name in names(text)}
            found |= (holds(text, named) << bit).astype(np.uint8)
        diverged = self.table.values("status", cells) == DIVERGED
        self.classes[cells] = np.where(diverged, DIVERGES, found)
        for name, values in self.metrics.items():
            values[cells] = self.table.values(name, cells)  # NaN where it diverged

    def measures(self) -> Iterator[Measure]:
        """What may differ in a box."""
        refine = self.grid.sweep.refine
        assert refine
        high = np.where(self.cells, self.classes, 0)
        yield Measure(self.classes, high, lambda a, b: np.where(a < b, np.inf, 0.0))
        for name, values in self.metrics.items():
            there = ~np.isnan(values)
            low, high = np.where(there, values, np.inf), np.where(there, values, -np.inf)
            yield Measure(low, high, _difference(name, refine.absolute, refine.relative))


def _difference(
    name: str, absolute: dict[str, float], relative: dict[str, float]
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """By how many tolerances the values in boxes differ."""

    def difference(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            if name in absolute:
                allowed = np.full_like(low, absolute[name])
            else:
                size = np.maximum(np.abs(low), np.abs(high))
                allowed = np.maximum(relative[name] * size, TRUST[name].floor)
            apart = np.where(high > low, high - low, 0.0)
            return np.where(np.isinf(apart), np.inf, apart / allowed)

    return difference


def rounds(writer: Writer, simulate: Simulate) -> Generator[Step]:
    """Refine a store to its end, or until cells can't be simulated: their blocks are set aside.

    Closing the generator, and Ctrl-C, write what was simulated.
    """
    run = _Run(writer, simulate)
    try:
        yield from run.rounds()
    except (GeneratorExit, KeyboardInterrupt):
        run.write()
        raise


class _Run:
    def __init__(self, writer: Writer, simulate: Simulate) -> None:
        self.writer, self.simulate = writer, simulate
        self.grid = grid = writer.store.grid
        refine = grid.sweep.refine
        assert refine
        dims = list(grid.dims)
        axes = tuple(sorted(dims.index(name) for name in grid.sweep.refined))
        self.boxes = Boxes(grid.shape, axes, refine.levels)
        self.table, self.journal = Table(grid), writer.store.journal
        self.table.read(writer.store)
        self.done = {row.block for row in writer.store.rows() if row.outcome == DONE}
        self.known = _Known(grid, self.table, writer.store.dtype)
        self.budget = grid.most_runs
        self.unwritten: list[np.ndarray] = []
        self.seconds, self.write_took = 0.0, 0.0
        self.ran, self.diverged = 0, 0
        self.error = ""
        self.left: int | None = None

    def rounds(self) -> Generator[Step]:
        yield Step(self.table.n)
        cells = self.boxes.coarse()
        while cells.size:
            yield from self._simulate(cells[self.table.row[cells] == NONE])
            if self.error:
                return
            self.known.add(cells)
            if self.left is not None:
                break
            proposal = self.boxes.propose(list(self.known.measures()))
            part, cells = self.boxes.within(proposal, self.known.cells, self.budget - self.known.n)
            self.boxes.halve(part)
            if len(part) < len(proposal):
                self.left = int(proposal.levels[len(part)])
        yield from self._finish()

    def _simulate(self, cells: np.ndarray) -> Generator[Step]:
        """Simulate cells of one round, in batches of one model."""
        for batch in self.grid.batches(cells):
            began = time.perf_counter()
            values = self._attempts(batch)
            if values is None:
                yield self._set_aside(batch)
                return
            self.table.add(batch, values)
            self.unwritten.append(batch)
            self.seconds += time.perf_counter() - began
            self.ran += len(batch)
            self.diverged += int(np.sum(values["status"] == DIVERGED))
            if self.seconds > max(WAIT, SHARE * self.write_took):
                self.write()
            yield self._step()

    def _step(self, *rows: Row) -> Step:
        return Step(self.table.n, self.ran, self.diverged, rows=rows)

    def _attempts(self, batch: np.ndarray) -> Values | None:
        for _ in range(ATTEMPTS):
            try:
                return self.simulate(batch)
            except Exception as error:  # the cells of other batches stay
                reason = f"{type(error).__name__}: {error}".splitlines()[0][:300]
        self.error = reason
        return None

    def write(self) -> None:
        """Write what was simulated since the last time into the journal. Raises OSError."""
        began = time.perf_counter()
        if self.unwritten:
            cells = np.concatenate(self.unwritten)
            self.journal.append(cells, {n: self.table.values(n, cells) for n in self.table.columns})
        self.unwritten, self.seconds = [], 0.0
        self.write_took = time.perf_counter() - began

    def _set_aside(self, batch: np.ndarray) -> Step:
        """Set the blocks of cells aside, which failed."""
        self.write()
        rows = []
        for block in np.unique(self.grid.block_of(batch)).tolist():
            values = no_values(self.grid, block)
            values["status"][np.isin(self.grid.cells_in(block), batch)] = FAILED
            row = Row(block, SET_ASIDE, attempt=ATTEMPTS, error=self.error)
            rows.append(self.writer.commit(values, row))
        return self._step(*rows)

    def _finish(self) -> Generator[Step]:
        """Give each cell a value, and write all blocks."""
        self.write()
        todo = [block for block in range(self.grid.n_blocks) if block not in self.done]
        for blocks, block in enumerate(todo, 1):
            self.writer.commit(self.table.done(block, self.boxes), Row(block, DONE))
            if blocks < len(todo):
                yield replace(self._step(), blocks=blocks)
        self.journal.clear()
        yield replace(self._step(), blocks=len(todo), ended=True, left=self.left)
