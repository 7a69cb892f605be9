"""A sweep's cells in blocks, and the scenarios of one block."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np

from fic_jax import QUANTITIES, Model, Params
from sweeps.plan.random_design import draw
from sweeps.plan.shard import Shard
from sweeps.spec.mistakes import SweepError
from sweeps.spec.types import Sweep

# The engine computes one block at a time, the store keeps it in one file for each variable, and an
# interruption costs at most one. A block takes a second or two, or longer if its SMALLEST_BLOCK
# scenarios have very many steps.
BLOCK_STEPS = 300_000_000  # plant steps
SMALLEST_BLOCK, LARGEST_BLOCK = 4_096, 1_000_000  # cells
# A reduced store has small values, and a file takes at least 4 kB of a disk: with more scenarios it
# gets blocks of up to LARGEST_BLOCK of them instead of more blocks.
FEW_BLOCKS = 1_000
MAX_BLOCKS = 1_000_000  # of a sweep: each is a file in every variable's folder and a ledger row
MAX_BLOCK = 10_000_000  # cells of a block: all metrics and errors of it take 1 GB of memory
ESTIMATE_COST = 6  # an error estimate adds a run with half the step and located switches

Block = tuple[slice, ...]


@dataclass(frozen=True)
class Grid:
    """The cells of a sweep, in blocks of at most `chunk` cells.

    A cell is one scenario's place in the product of the sweep's dimensions; with a reduction, it is
    the place of all scenarios that differ in the dimensions that go. Raises SweepError if `chunk`
    makes too many blocks for a ledger or a block too large for memory, or if there are more shards
    than blocks.
    """

    sweep: Sweep
    chunk: int | None = None  # most cells of a block; None: as many as take a second or two
    shard: Shard | None = None  # whose blocks are run; None: all are

    def __post_init__(self) -> None:
        if self.chunk is not None and not (type(self.chunk) is int and self.chunk > 0):
            wanted = "a whole number of cells, 1 or more"
            raise SweepError(f"{self.sweep.name}: chunk must be {wanted}, not {self.chunk!r}")
        for what, n, most in (
            ("blocks", self.n_blocks, MAX_BLOCKS),
            ("cells in a block", math.prod(self.block_shape) * self.candidates, MAX_BLOCK),
        ):
            if n > most:
                wanted = f"a number of cells that makes at most {most:,} {what}"
                raise SweepError(f"{self.sweep.name}: `--chunk` must be {wanted}, not {n:,}")
        if self.shard and self.sweep.refine:
            why = "is refined where its cells differ, which no shard knows of the others"
            raise SweepError(f"--shard {self.shard}: {self.sweep.name} {why}; run it whole")
        if self.shard and self.shard.n > self.n_blocks:
            limit = (
                f"N must be at most {self.n_blocks:,}, the number of blocks of {self.sweep.name}"
            )
            raise SweepError(f"--shard {self.shard}: {limit}; a smaller --chunk makes more")

    @cached_property
    def dims(self) -> dict[str, int]:
        """Name and length of each dimension of the store, in order."""
        gone = self.sweep.reduce.gone if self.sweep.reduce else ()
        return {name: n for name, n in self.sweep.dims.items() if name not in gone}

    @cached_property
    def full(self) -> "Grid":
        """All scenarios, each in its own cell: this grid unless it is reduced."""
        return Grid(self.sweep.model_copy(update={"reduce": None})) if self.sweep.reduce else self

    @property
    def combinations(self) -> int:
        """Scenarios of a cell."""
        return math.prod(self.sweep.dims.values()) // self.cells

    @property
    def candidates(self) -> int:
        """Values of a dimension from which a reduction chooses the best one; 1 if there is none."""
        best = self.sweep.reduce.best if self.sweep.reduce else None
        return self.sweep.dims[best] if best else 1

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.dims.values())

    @property
    def cells(self) -> int:
        return math.prod(self.shape)

    @property
    def most_runs(self) -> int:
        """The most scenarios that a run of these cells simulates."""
        scenarios, refine = self.own_cells * self.combinations, self.sweep.refine
        return min(refine.budget, scenarios) if refine and refine.budget else scenarios

    @property
    def block_cells(self) -> int:
        """The most cells a block may have."""
        if self.chunk:
            return self.chunk
        scenarios = self.second_or_two
        if self.sweep.refine:  # few of its cells are simulated
            scenarios = LARGEST_BLOCK
        if self.sweep.reduce:
            enough = min(self.full.cells // FEW_BLOCKS, LARGEST_BLOCK)
            scenarios = max(scenarios, enough)
        cells = max(scenarios // self.combinations, 1)
        return max(cells, 4 * self.cells // MAX_BLOCKS)  # halving may make blocks 4 times smaller

    @property
    def second_or_two(self) -> int:
        """The scenarios that take so long to simulate."""
        return min(max(BLOCK_STEPS // self.work, SMALLEST_BLOCK), LARGEST_BLOCK)

    @property
    def work(self) -> int:
        """Cost of a scenario, in plant steps of a run without an error estimate."""
        return self.sweep.n_steps * (ESTIMATE_COST if self.sweep.error_estimate else 1)

    @cached_property
    def block_shape(self) -> tuple[int, ...]:
        """Cells of a block along each dimension: the longest side is halved until a block fits.

        All cells of a block have the same model, because each model is its own compiled program.
        """
        return self.halved(self.dims, self.block_cells)

    def halved(self, dims: Mapping[str, int], most: int) -> tuple[int, ...]:
        """Sides of a box of at most `most` cells along some dimensions; 1 along a choice."""
        sides = [1 if dim in self.sweep.model else n for dim, n in dims.items()]
        while math.prod(sides) > most:
            longest = sides.index(max(sides))
            sides[longest] = -(-sides[longest] // 2)
        return tuple(sides)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of blocks along each dimension."""
        return tuple(-(-n // b) for n, b in zip(self.shape, self.block_shape, strict=True))

    @property
    def n_blocks(self) -> int:
        return math.prod(self.counts)

    @cached_property
    def own(self) -> Sequence[int]:
        """The numbers of the blocks to run, in order."""
        return self.shard.blocks(self.n_blocks) if self.shard else range(self.n_blocks)

    def owns(self, block: int) -> bool:
        """Whether a block is one of those to run."""
        return 0 <= block < self.n_blocks and (self.shard is None or self.shard.has(block))

    @cached_property
    def own_cells(self) -> int:
        """Number of cells in the blocks to run."""
        if not self.shard:
            return self.cells
        dims = zip(self.shape, self.block_shape, strict=True)
        cells = np.ones(1, np.int64)  # of each block
        for n, side in dims:
            cells = np.outer(cells, np.diff(np.append(np.arange(0, n, side), n))).ravel()
        return int(cells[list(self.own)].sum())

    def place(self, index: int) -> tuple[int, ...]:
        """A block's index along each dimension; along the last one, numbers are consecutive."""
        return tuple(int(i) for i in np.unravel_index(index, self.counts))

    def block(self, index: int) -> Block:
        """The cells of a block: a slice along each dimension."""
        dims = zip(self.place(index), self.block_shape, self.shape, strict=True)
        return tuple(slice(i * side, min((i + 1) * side, n)) for i, side, n in dims)

    def blocks(self) -> Iterator[Block]:
        """All blocks, in the order of their numbers."""
        return (self.block(index) for index in range(self.n_blocks))

    def model(self, block: Block) -> Model:
        """The model that all scenarios of a block share."""
        start = {dim: part.start for dim, part in zip(self.dims, block, strict=True)}
        choices = self.sweep.model.items()
        chosen = {n: c[start[n]] if isinstance(c, list) else c for n, c in choices}
        return Model(**cast(Any, chosen))

    def params(self, block: Block, dtype: str = "float64") -> Params:
        """The scenarios of a block: swept fields are arrays [cells], the last dimension fastest.

        Fields that do not vary are scalars. All are of `dtype`.
        """
        shape = shape_of(block)
        fields: dict[str, Any] = vars(Params()) | self.sweep.constants
        for i, (dim, part) in enumerate(zip(self.dims, block, strict=True)):
            for name, values in self.coordinates(dim, part).items():
                if name in QUANTITIES:
                    sides = [-1 if j == i else 1 for j in range(len(shape))]
                    along = np.asarray(values, dtype).reshape(sides)
                    fields[name] = np.broadcast_to(along, shape).reshape(-1)
        return Params(**{name: np.asarray(value, dtype) for name, value in fields.items()})

    def cells_in(self, index: int) -> np.ndarray:
        """The numbers of a block's cells among all cells, in storage order."""
        along = np.ix_(*(np.arange(part.start, part.stop) for part in self.block(index)))
        return np.ravel_multi_index(along, self.shape).ravel()

    def block_of(self, cells: np.ndarray) -> np.ndarray:
        """The number of the block of each cell."""
        sides = zip(np.unravel_index(cells, self.shape), self.block_shape, strict=True)
        return np.ravel_multi_index([index // side for index, side in sides], self.counts)

    def batches(self, cells: np.ndarray) -> Iterator[np.ndarray]:
        """Cells anywhere in the grid, by number, in parts of one model and a second or two."""
        most = min(self.block_cells, self.second_or_two)
        index = np.unravel_index(cells, self.shape)
        models = [i for dim, i in zip(self.dims, index, strict=True) if dim in self.sweep.model]
        lengths = [n for dim, n in self.dims.items() if dim in self.sweep.model]
        number = np.ravel_multi_index(models, lengths) if models else np.zeros(len(cells), int)
        for one in np.unique(number):
            same = cells[number == one]
            for start in range(0, len(same), most):
                yield same[start : start + most]

    def scenarios(self, cells: np.ndarray, dtype: str = "float64") -> tuple[Params, Model]:
        """The scenarios of cells anywhere in the grid, and the model that all of them share.

        The Params are those of `params`, bit for bit.
        """
        index = np.unravel_index(cells, self.shape)
        fields: dict[str, Any] = vars(Params()) | self.sweep.constants
        for dim, along in zip(self.dims, index, strict=True):
            for name, values in self.coordinates(dim).items():
                if name in QUANTITIES:
                    fields[name] = np.asarray(values, dtype)[along]
        first = tuple(slice(int(along[0]), int(along[0]) + 1) for along in index)
        params = {name: np.asarray(value, dtype) for name, value in fields.items()}
        return Params(**params), self.model(first)

    def coordinates(self, dim: str, part: slice = slice(None)) -> dict[str, np.ndarray]:
        """Values at the indices `part` of all that varies along a dimension, by name."""
        sweep = self.sweep
        start, stop, _ = part.indices(self.dims[dim])
        if dim in sweep.axes:
            return {dim: sweep.axis_values(dim, part)}
        if dim == "case":
            columns = {name: np.array(column)[part] for name, column in sweep.cases.items()}
            return {"case": np.arange(start, stop)} | columns
        if dim == "scenario" and sweep.sample:
            return draw(sweep.sample, start, stop)
        return {dim: np.array(sweep.model[dim])[part]}


def shape_of(block: Block) -> tuple[int, ...]:
    """Number of cells of a block along each dimension."""
    return tuple(part.stop - part.start for part in block)


def cells_of(block: Block) -> int:
    """Number of scenarios of a block."""
    return math.prod(shape_of(block))
