"""The boxes of a refined grid: which differ, which are halved, where the next value is."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sweeps.plan.grid import Block, shape_of

PIECE = 100_000  # boxes at once: their cells take 65 MB in four dimensions
Reduce = Callable[[np.ndarray, np.ndarray], np.ndarray]  # np.minimum or np.maximum


@dataclass(frozen=True)
class Measure:
    """What may differ in a box: the smallest and the largest value, cell by cell.

    A cell that is not known has a `low` above its `high`: it makes no difference.
    """

    low: np.ndarray  # [cells of the finest grid]
    high: np.ndarray
    # (least, most) of boxes -> by how much they differ; more than 1 halves a box
    difference: Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Proposal:
    """Boxes that a round would halve, in the order in which a budget is spent on them."""

    levels: np.ndarray  # [boxes]
    boxes: np.ndarray  # [boxes], number among the boxes of the level

    def __len__(self) -> int:
        return len(self.boxes)


@dataclass
class Boxes:
    """The boxes of a grid whose refined dimensions have m 2^levels + 1 cells.

    Along the other dimensions a box has one cell. An array of boxes of a level has the shape
    `self.sides(level)`.
    """

    shape: tuple[int, ...]  # cells of the finest grid
    refined: tuple[int, ...]  # dimensions that are halved
    levels: int
    split: list[np.ndarray] = field(init=False)  # level -> bool, boxes that are halved

    def __post_init__(self) -> None:
        self.split = [np.zeros(self.sides(level), bool) for level in range(self.levels)]

    def sides(self, level: int) -> tuple[int, ...]:
        """Number of boxes of a level along each dimension."""
        step = self.step(level)
        return tuple(
            (n - 1) // step if axis in self.refined else n for axis, n in enumerate(self.shape)
        )

    def step(self, level: int) -> int:
        """Finest cells from one corner of a box to the next."""
        return 1 << (self.levels - level)

    def coarse(self) -> np.ndarray:
        """The numbers of the cells of level 0."""
        step = self.step(0)
        along = (
            np.arange(0, n, step if axis in self.refined else 1)
            for axis, n in enumerate(self.shape)
        )
        return np.ravel_multi_index(np.ix_(*along), self.shape).ravel()

    def propose(self, measures: Sequence[Measure]) -> Proposal:
        """The boxes that differ, and their neighbours of the same level, as far as not halved.

        The coarsest come first; among them those that differ most, and their neighbours last.
        """
        most: list[np.ndarray | None] = [None] * self.levels
        for one in measures:
            low_ends = self._pyramid(one.low, np.minimum)
            high_ends = self._pyramid(one.high, np.maximum)
            finest_first = reversed(range(self.levels))
            for level, low, high in zip(finest_first, low_ends, high_ends, strict=True):
                found, before = one.difference(low, high), most[level]
                most[level] = found if before is None else np.maximum(before, found)
        levels, boxes, differences = [], [], []
        exists = np.ones(self.sides(0), bool)
        for level, difference in enumerate(most):
            assert difference is not None
            differ = exists & (difference > 1)
            new = np.flatnonzero(self._with_neighbours(differ) & exists & ~self.split[level])
            levels.append(np.full(len(new), level))
            boxes.append(new)
            differences.append(np.where(differ, difference, 0).ravel()[new])
            exists = self._halved(self.split[level])
        number, level_of = np.concatenate(boxes), np.concatenate(levels)
        order = np.lexsort((number, -np.concatenate(differences), level_of))
        return Proposal(level_of[order], number[order])

    def within(
        self, proposal: Proposal, known: np.ndarray, budget: int
    ) -> tuple[Proposal, np.ndarray]:
        """The first boxes of a proposal that need at most `budget` new cells, and these cells."""
        taken, found, claimed = 0, [], known.copy()
        for level, boxes in self._pieces(proposal):
            needed = self._needed(level, boxes)
            new = np.flatnonzero(~claimed[needed.ravel()])
            cells, first = np.unique(needed.ravel()[new], return_index=True)
            box_of = new[first] // needed.shape[1]  # the first box that needs the cell
            spent = np.cumsum(np.bincount(box_of, minlength=len(boxes)))
            n = int(np.searchsorted(spent, budget, "right"))
            found.append(cells[box_of < n])
            claimed[found[-1]] = True
            taken, budget = taken + n, budget - len(found[-1])
            if n < len(boxes):
                break
        part = Proposal(proposal.levels[:taken], proposal.boxes[:taken])
        return part, np.sort(np.concatenate([*found, np.zeros(0, np.int64)]))

    def _pieces(self, proposal: Proposal) -> Iterator[tuple[int, np.ndarray]]:
        """Boxes of one level, at most PIECE at a time."""
        for level in range(self.levels):
            boxes = proposal.boxes[proposal.levels == level]
            for start in range(0, len(boxes), PIECE):
                yield level, boxes[start : start + PIECE]

    def halve(self, proposal: Proposal) -> None:
        """Halve boxes."""
        for level, split in enumerate(self.split):
            split.ravel()[proposal.boxes[proposal.levels == level]] = True

    @cached_property
    def leaves(self) -> np.ndarray:
        """Level of the box around each box of the finest level; to be asked once all are halved."""
        found = np.zeros(self.sides(0), np.uint8)
        for level, split in enumerate(self.split):
            found = self._halved(found)
            found[self._halved(split)] = level + 1
        return found

    def around(self, block: Block) -> tuple[np.ndarray, np.ndarray]:
        """Of each cell of a block: the level of its box, and the number of the nearest corner.

        A cell between boxes is in the finest of them, or in the one with the larger indices; of two
        corners that are as near it gets the one with the smaller index.
        """
        along = [np.arange(part.start, part.stop) for part in block]
        shape = shape_of(block)
        level = np.full(shape, -1)
        back = {axis: np.zeros(shape, np.int64) for axis in self.refined}
        for steps in itertools.product((0, 1), repeat=len(self.refined)):
            inside = list(along)
            for step, axis in zip(steps, self.refined, strict=True):
                inside[axis] = np.clip(along[axis] - step, 0, self.shape[axis] - 2)
            found = self.leaves[np.ix_(*inside)]
            finer = found > level
            level = np.where(finer, found, level)
            for step, axis in zip(steps, self.refined, strict=True):
                back[axis][finer] = step
        shift, corners = self.levels - level, []
        for axis, place in enumerate(np.ix_(*along)):
            corner = np.broadcast_to(place, shape)
            if axis in self.refined:
                box = np.clip(place - back[axis], 0, self.shape[axis] - 2) >> shift << shift
                corner = box + ((2 * (place - box) > 1 << shift) << shift)
            corners.append(corner)
        return level, np.ravel_multi_index(corners, self.shape)

    def _pyramid(self, cells: np.ndarray, reduce: Reduce) -> Iterator[np.ndarray]:
        """The smallest (or largest) value in each box, faces included: finest boxes first.

        The boxes are those that can be halved, of 3^d cells or more.
        """
        found = cells.reshape(self.shape)
        for axis in self.refined:
            low, middle, high = (
                found[(slice(None),) * axis + (part,)]
                for part in (slice(0, -1, 2), slice(1, None, 2), slice(2, None, 2))
            )
            found = reduce(reduce(low, middle), high)
        yield found
        for _ in range(self.levels - 1):
            for axis in self.refined:
                first, second = (
                    found[(slice(None),) * axis + (slice(start, None, 2),)] for start in (0, 1)
                )
                found = reduce(first, second)
            yield found

    def _halved(self, boxes: np.ndarray) -> np.ndarray:
        """An array of boxes as one of their parts, a level finer."""
        for axis in self.refined:
            boxes = np.repeat(boxes, 2, axis)
        return boxes

    def _with_neighbours(self, boxes: np.ndarray) -> np.ndarray:
        """Boxes, and those that touch one of them."""
        for axis in self.refined:
            before = (slice(None),) * axis
            wider = boxes.copy()
            wider[(*before, slice(1, None))] |= boxes[(*before, slice(0, -1))]
            wider[(*before, slice(0, -1))] |= boxes[(*before, slice(1, None))]
            boxes = wider
        return boxes

    def _needed(self, level: int, boxes: np.ndarray) -> np.ndarray:
        """The numbers of the corners of the parts of each box [boxes, 3^d]."""
        step, half = self.step(level), self.step(level + 1)
        first = [
            index * step if axis in self.refined else index
            for axis, index in enumerate(np.unravel_index(boxes, self.sides(level)))
        ]
        stride = [math.prod(self.shape[axis + 1 :]) for axis in range(len(self.shape))]
        corner = np.ravel_multi_index(first, self.shape)
        offsets = [
            sum(half * i * stride[axis] for i, axis in zip(steps, self.refined, strict=True))
            for steps in itertools.product(range(3), repeat=len(self.refined))
        ]
        return corner[:, None] + np.array(offsets, np.int64)[None, :]
