"""A store that gains values, an axis or scenarios, and keeps every number it has."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fic_jax import CHOICES, Model, Params
from sweeps.plan.grid import Grid, shape_of
from sweeps.provenance import KEPT
from sweeps.spec.mistakes import SweepError
from sweeps.spec.types import Sweep
from sweeps.store import fsync as durable
from sweeps.store.commit import Values, Writer, changing, no_values, now
from sweeps.store.format import away, building, lay_out, refuse_small_disk
from sweeps.store.fsync import PARTIAL
from sweeps.store.ledger import DONE, PARTLY, Row, intact
from sweeps.store.opening import DIVERGED, OK, Store, open_store


def extend(store: Store, plan: Sweep, source: str) -> Store:
    """The store as the beginning of a larger sweep: every cell it has is there, bit for bit.

    The larger store is built beside it and takes its place once all of it is on the disk. Raises
    SweepError, with a line for each thing in the way, if `plan` (from `source`) is not larger.
    """
    problems = list(_differences(store.grid.sweep, plan))
    grid = Grid(plan, store.grid.chunk)
    if not problems:
        problems = list(_losses(store.grid, grid))
    if problems:
        raise SweepError("\n".join(f"{source}: {told}" for told in problems))
    path, partial = store.path, store.path.with_name(f".{store.path.name}{PARTIAL}")
    refuse_small_disk(path, grid, store.dtype)
    attrs = store.group.attrs.asdict()
    attributes = {key: attrs[key] for key in KEPT if key in attrs} | {"extended": now()}
    # in this order the new store is owned until it is sealed
    with building(partial), changing(store):
        store.refuse_missing()
        wrong = sum(1 for row in store.rows() for _ in _wrong(store, row))
        if wrong:  # a whole file in the place of another would be carried over
            raise store.damaged(f"{wrong:,} files of finished blocks are not as written")
        lay_out(partial, grid, attributes)
        writer = Writer(open_store(partial))
        for values, row in _carried(store, grid):
            writer.commit(values, row)
        durable.sync_tree(partial)
        path.rename(away(path))
        partial.rename(path)
        durable.sync(path.parent)
    shutil.rmtree(away(path), ignore_errors=True)
    return open_store(path)


def _wrong(store: Store, row: Row) -> Iterator[str]:
    return (n for n, stamp in row.files.items() if not intact(store.file(n, row.block), stamp))


def recover(path: Path) -> None:
    """Finish or undo what a kill left of an extension: one store, whole, under its name."""
    before = away(path)
    if not os.path.isdir(before) or before.is_symlink():
        return
    if os.path.isfile(path / "zarr.json"):
        shutil.rmtree(before)
    elif not os.path.lexists(path):
        before.rename(path)


def _differences(old: Sweep, new: Sweep) -> Iterator[str]:
    """What must be the same in both sweeps, and is not."""
    for key in ("time", "error_estimate"):
        if getattr(old, key) != getattr(new, key):
            yield f"`{key}` must be that of the store, {getattr(old, key)}."
    if set(old.metrics) != set(new.metrics):
        yield f"`metrics` must be those of the store, {old.metrics}."
    if old.sample and new.sample:
        for key in ("method", "seed", "ranges"):
            if getattr(old.sample, key) != getattr(new.sample, key):
                yield f"`sample.{key}` must be that of the store: another one is another sample."
        ranges, asked = old.sample.ranges, new.sample.ranges
        if ranges == asked and list(ranges) != list(asked):
            yield "`sample.ranges` must be in the store's order: a range is drawn by its place."
        if old.sample.method == "lhs" and old.sample.n != new.sample.n:
            yield "`sample.n` can't be changed with lhs: every scenario depends on it."
    elif new.sample:
        yield "`sample` can't be added: its scenarios are not those of the store."


def _losses(old: Grid, new: Grid) -> Iterator[str]:
    """What of the store the larger sweep would not have."""
    before, after = _fixed(old), _fixed(new)
    for dim in old.dims:
        if dim not in new.dims:
            yield f"`{dim}` must stay a dimension: the store has {old.dims[dim]} places along it."
    for name, value in before.items():
        if name in after and after[name] != value:
            yield f"`{name}` must stay {value}, as in the store, or be an axis with {value} in it."
    for dim in new.dims:
        here, known = _along(new, dim), _along(old, dim)
        moved = [n for n in here if n not in before and n not in known]
        moved += [n for n in known if n not in here]
        if moved:
            yield f"`{moved[0]}` must stay where it is in the store's sweep."
            return
        there = set(_places(old, new, dim).tolist()) - {-1}
        lost = sorted(set(range(old.dims.get(dim, 1))) - there)
        if lost and dim in old.dims:
            place = {n: v[lost[0]] for n, v in known.items()}
            told = ", ".join(f"{n} = {v}" for n, v in place.items())
            yield f"`{dim}` must keep what the store has, but lacks {told}."
        elif lost:
            told = ", ".join(f"{n} = {before[n]}" for n in here)
            yield f"`{dim}` must contain {told}, which the store was run with."


def _along(grid: Grid, dim: str) -> dict[str, np.ndarray]:
    """Fields and choices that vary along a dimension; none where there is no such dimension."""
    if dim not in grid.dims:
        return {}
    if dim == "scenario":  # by number: the same sample gives the same scenarios
        return {dim: np.arange(grid.dims[dim])}
    values = grid.coordinates(dim)
    return {name: v for name, v in values.items() if name != "case"}


def _fixed(grid: Grid) -> dict[str, Any]:
    """Fields and choices that do not vary, with their values."""
    model, constants = grid.sweep.model, grid.sweep.constants
    fixed = {name: getattr(Model(), name) for name in CHOICES} | dict(model)
    fixed |= vars(Params()) | dict(constants)
    swept = {name for dim in grid.dims for name in grid.coordinates(dim, slice(0, 1))}
    return {name: value for name, value in fixed.items() if name not in swept}


def _places(old: Grid, new: Grid, dim: str) -> np.ndarray:
    """For each place along a dimension of the new sweep the one in the old, -1 where it is none."""
    values, known, fixed = _along(new, dim), _along(old, dim), _fixed(old)
    length = new.dims[dim]
    same = np.ones(length, bool)
    for name in values.keys() - known.keys():
        same &= values[name] == fixed[name]
    if not known:
        return np.where(same, 0, -1)
    keys = list(zip(*(known[name].tolist() for name in known), strict=True))
    index = {key: i for i, key in enumerate(keys)}
    asked = zip(*(values[name].tolist() for name in known), strict=True)
    # a case may be there twice: then each is its own
    found = [i if keys[i : i + 1] == [key] else index.get(key, -1) for i, key in enumerate(asked)]
    return np.where(same, found, -1)


@dataclass(frozen=True)
class _Map:
    """Where the cells of a larger sweep are in the store."""

    places: list[np.ndarray]  # a dimension of the larger sweep -> place in the store's, or -1
    axes: list[int]  # a dimension of the store -> which one of the larger sweep it is
    finished: np.ndarray  # blocks of the store: whether they are in the ledger


def _carried(store: Store, grid: Grid) -> Iterator[tuple[Values, Row]]:
    """Every block of the larger sweep of which the store has something."""
    finished = np.zeros(store.grid.counts, bool)
    finished.flat[[row.block for row in store.rows()]] = True
    dims = list(grid.dims)
    places = [_places(store.grid, grid, dim) for dim in dims]
    where = _Map(places, [dims.index(dim) for dim in store.grid.dims], finished)
    for index in range(grid.n_blocks):
        values = _gathered(store, grid, index, where)
        if values is not None:
            known = np.isin(values["status"], (OK, DIVERGED))
            if known.any():
                yield values, Row(index, DONE if known.all() else PARTLY)


def _gathered(store: Store, grid: Grid, index: int, where: _Map) -> Values | None:
    """A block of the larger sweep with the store's numbers in it; None if it has none of it."""
    block = grid.block(index)
    parts = [places[part] for places, part in zip(where.places, block, strict=True)]
    inside = [np.flatnonzero(part >= 0) for part in parts]
    if not all(len(i) for i in inside):
        return None
    source = [parts[axis][inside[axis]] for axis in where.axes]  # a list a dimension of the store
    shape = shape_of(block)
    sides = [part // side for part, side in zip(source, store.grid.block_shape, strict=True)]

    def spread(found: np.ndarray) -> np.ndarray:
        """From the dimensions of the store to those of the larger sweep, for broadcasting."""
        order = np.argsort(where.axes)
        ordered = np.transpose(found, order)
        lengths = iter(ordered.shape)
        return ordered.reshape([next(lengths) if i in where.axes else 1 for i in range(len(shape))])

    found = {n: spread(np.asarray(store.array(n).oindex[tuple(source)])) for n in store.variables}
    known = spread(where.finished[np.ix_(*sides)]) & np.isin(found["status"], (OK, DIVERGED))
    values = no_values(grid, index)
    for name in store.variables:
        whole = values[name].reshape(shape)  # a view
        whole[np.ix_(*inside)] = np.where(known, found[name], whole.flat[0])
    return values
