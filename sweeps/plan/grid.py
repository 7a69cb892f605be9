"""The plan: a sweep's dimensions, its blocks, and the scenarios of a block from its own indices."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np

from fic_jax import QUANTITIES, Model, Params
from sweeps.plan.design import draw
from sweeps.spec.types import Sweep, SweepError

# A block is the unit of work, of storage and of what an interruption costs: a second or two, unless
# a scenario is so long that the smallest block takes more.
BLOCK_STEPS = 300_000_000
SMALLEST_BLOCK, LARGEST_BLOCK = 4_096, 1_000_000
MAX_BLOCKS = 1_000_000  # of a sweep: files in one folder, rows of a ledger that is read whole
MAX_BLOCK = 10_000_000  # cells of a block: it is held in memory, 1 GB with all metrics and errors
ESTIMATE_COST = 6  # times the work of a scenario: two runs, one of smaller steps with events

Block = tuple[slice, ...]


@dataclass(frozen=True)
class Grid:
    """The cells of a sweep in blocks of at most `chunk` cells; no array of them ever exists.

    Dimensions in order: model choices given as lists, axes, `case`, `scenario`.
    """

    sweep: Sweep
    chunk: int | None = None  # cells of a block; chosen from the number of steps if None

    def __post_init__(self) -> None:
        """Refuse what no ledger or no memory holds. Raises SweepError."""
        for what, n, most in (
            ("blocks", self.n_blocks, MAX_BLOCKS),
            ("cells in a block", math.prod(self.block_shape), MAX_BLOCK),
        ):
            if n > most:
                wanted = f"a number of cells that makes at most {most:,} {what}"
                raise SweepError(f"{self.sweep.name}: `--chunk` must be {wanted}, not {n:,}")

    @cached_property
    def dims(self) -> dict[str, int]:
        """Name and length of each dimension."""
        return dims_of(self.sweep)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.dims.values())

    @property
    def cells(self) -> int:
        return math.prod(self.shape)

    @property
    def block_cells(self) -> int:
        """Cells that a block may have."""
        if self.chunk:
            return self.chunk
        chosen = min(max(BLOCK_STEPS // self.work, SMALLEST_BLOCK), LARGEST_BLOCK)
        return max(chosen, 4 * self.cells // MAX_BLOCKS)  # halving makes them up to 4 times smaller

    @property
    def work(self) -> int:
        """What a scenario costs, in plant steps without an estimate."""
        return self.sweep.n_steps * (ESTIMATE_COST if self.sweep.error_estimate else 1)

    @cached_property
    def block_shape(self) -> tuple[int, ...]:
        """Near-cubic blocks: the longest side is halved until a block fits.

        One model to a block, since another model is another program.
        """
        choices = self.sweep.model
        sides = [1 if isinstance(choices.get(d), list) else n for d, n in self.dims.items()]
        while math.prod(sides) > self.block_cells:
            longest = sides.index(max(sides))
            sides[longest] = -(-sides[longest] // 2)
        return tuple(sides)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Blocks along each dimension."""
        return tuple(-(-n // b) for n, b in zip(self.shape, self.block_shape, strict=True))

    @property
    def n_blocks(self) -> int:
        return math.prod(self.counts)

    def place(self, index: int) -> tuple[int, ...]:
        """Where a block is in the grid of blocks; they are numbered in storage order."""
        return tuple(int(i) for i in np.unravel_index(index, self.counts))

    def block(self, index: int) -> Block:
        """The cells of a block, a slice per dimension."""
        sides = zip(self.place(index), self.block_shape, self.shape, strict=True)
        return tuple(slice(i * b, min((i + 1) * b, n)) for i, b, n in sides)

    def blocks(self) -> Iterator[Block]:
        """The blocks in storage order."""
        return (self.block(index) for index in range(self.n_blocks))

    def model(self, block: Block) -> Model:
        """The model of a block."""
        chosen: dict[str, str] = {}
        place = dict(zip(self.dims, block, strict=True))
        for name, choice in self.sweep.model.items():
            chosen[name] = choice[place[name].start] if isinstance(choice, list) else choice
        return Model(**cast(Any, chosen))

    def params(self, block: Block, dtype: str | None = None) -> Params:
        """The scenarios of a block, flat in storage order; constant fields stay scalars.

        What varies is of `dtype`, or as the sweep has it.
        """
        shape = shape_of(block)
        columns: dict[str, Any] = dict(self.sweep.constants)
        for i, (dim, part) in enumerate(zip(self.dims, block, strict=True)):
            for name, values in self.coordinates(dim, part).items():
                if name in QUANTITIES:
                    sides = [-1 if j == i else 1 for j in range(len(shape))]
                    along = np.asarray(values, dtype).reshape(sides)
                    columns[name] = np.broadcast_to(along, shape).reshape(-1)
        return Params(**columns)

    def coordinates(self, dim: str, part: slice = slice(None)) -> dict[str, np.ndarray]:
        """What varies along a dimension: name -> values over the indices `part`."""
        sweep = self.sweep
        start, stop, _ = part.indices(self.dims[dim])
        if dim in sweep.axes:
            return {dim: sweep.axis_values(dim, part)}
        if dim == "case":
            columns = {name: np.array(column)[start:stop] for name, column in sweep.cases.items()}
            return {"case": np.arange(start, stop)} | columns
        if dim == "scenario" and sweep.sample:
            return draw(sweep.sample, start, stop)
        return {dim: np.array(sweep.model[dim])[start:stop]}


def dims_of(sweep: Sweep) -> dict[str, int]:
    """Name and length of each dimension of a sweep."""
    dims = {name: len(c) for name, c in sweep.model.items() if isinstance(c, list)}
    for name, axis in sweep.axes.items():
        dims[name] = len(axis) if isinstance(axis, list) else axis.n
    if sweep.cases:
        dims["case"] = len(next(iter(sweep.cases.values())))
    if sweep.sample:
        dims["scenario"] = sweep.sample.n
    return dims


def shape_of(block: Block) -> tuple[int, ...]:
    """Cells of a block along each dimension."""
    return tuple(part.stop - part.start for part in block)


def cells_of(block: Block) -> int:
    """Scenarios of a block."""
    return math.prod(shape_of(block))
