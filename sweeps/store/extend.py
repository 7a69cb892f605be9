"""Copy a store into a larger one: more values, axes, choices or scenarios, and no number changed.

First `_settled` gives the larger plan the store's values where the two differ by rounding alone.
`_differences` and `_losses` compare the two plans. `_places` then maps each dimension of the larger
plan to places in the store, and `_gather` copies the cells of each block.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fic_jax import QUANTITIES
from sweeps.plan.grid import Grid, shape_of
from sweeps.spec.mistakes import SweepError, command
from sweeps.spec.types import Sweep
from sweeps.store import fsync
from sweeps.store.commit import Values, Writer, no_values, now, writing
from sweeps.store.create import (
    building,
    partial_of,
    refuse_small_disk,
    write_empty,
)
from sweeps.store.format import AT_END, DIVERGED, OK, attributes
from sweeps.store.ledger import DONE, PARTLY, Row, intact
from sweeps.store.opening import Store, open_store
from sweeps.store.place import before_extension, place_of_store
from sweeps.store.verify import foreign_files

LONGEST_LIST = 100_000  # values of an axis that becomes a list: a store's record must stay small


def extend(store: Store, plan: Sweep, source: str) -> Store:
    """The store as the beginning of a larger sweep, with every number it has, bit for bit.

    The larger store is built beside it, and takes its name once all of it is on the disk. Raises
    SweepError, with a line for each reason, if `plan` (from the file `source`) is not larger.
    """
    if store.grid.shard:
        whole = f"{command('merge', '--help')} says how all become one store, which can be extended"
        raise SweepError(f"{store.path}: is shard {store.grid.shard}; {whole}")
    if store.grid.sweep.refine or plan.refine:
        again = "run the larger sweep into a new store"
        raise SweepError(f"{source}: a refined sweep can't be extended; {again}")
    plan = _settled(store.grid.sweep, plan)
    problems = list(_differences(store, plan))
    grid = Grid(plan, store.grid.chunk)
    if not problems:
        problems = list(_losses(store.grid, grid))
    if problems:
        raise SweepError("\n".join(f"{source}: {problem}" for problem in problems))

    def fill(writer: Writer) -> None:
        for values, row in _blocks_with_known_cells(store, grid):
            writer.commit(values, row)

    return replaced(store, grid, fill)


def replaced(store: Store, grid: Grid, fill: Callable[[Writer], None]) -> Store:
    """A store of another plan in the place of `store`, with what `fill` writes; its notes stay.

    It takes the name once all of it is on the disk. Raises SweepError, OSError.
    """
    path, partial = store.path, partial_of(store.path)
    refuse_small_disk(path, grid, store.dtype)
    of_sweep = {*attributes(grid), "coordinates", *AT_END}
    made_by = {k: v for k, v in store.group.attrs.asdict().items() if k not in of_sweep}
    # In this order the new store is locked until its ledger has a checksum.
    with building(partial), writing(store):
        store.check_files()
        wrong = sum(not intact(*file) for row in store.rows() for file in store.files(row))
        if wrong:  # we would copy another block's numbers
            raise store.damaged(f"{wrong:,} files of finished blocks are not as written")
        write_empty(partial, grid, made_by | {"extended": now()})
        fill(Writer(open_store(partial)))
        fsync.sync_tree(partial)
        path.rename(before_extension(path))
        partial.rename(path)
        fsync.sync(path.parent)
    _dismiss(before_extension(path), path)
    return open_store(path)


def _dismiss(before: Path, path: Path) -> None:
    """Delete the store that another one has replaced; notes of the user in it go along."""
    with suppress(SweepError, OSError):  # a kill may have come while it was deleted
        for name in foreign_files(open_store(before)):
            with suppress(OSError):  # a folder went with all that is in it
                os.rename(before / name, path / name)
    shutil.rmtree(before, ignore_errors=True)


def recover(path: Path) -> None:
    """Finish or undo an extension that a kill cut short: one whole store remains, as `path`."""
    path = place_of_store(path)
    before = before_extension(path)
    if not os.path.isdir(before) or before.is_symlink():
        return
    if os.path.isfile(path / "zarr.json"):
        _dismiss(before, path)
    elif not os.path.lexists(path):
        before.rename(path)


def _settled(old: Sweep, new: Sweep) -> Sweep:
    """The larger sweep, with the store's value for each value that equals it to rounding.

    Two ranges that share a value may compute it with different last bits. The cells of the store
    were run at the store's value, so an axis with another last bit becomes a list.
    """
    drawn = {*(old.sample.ranges if old.sample else ()), *(new.sample.ranges if new.sample else ())}
    constants, axes, cases = dict(new.constants), dict(new.axes), dict(new.cases)
    for name in QUANTITIES.keys() - drawn:
        known, given = (sweep.field_values(name) for sweep in (old, new))
        rounding = np.maximum(new.rounding(name, given), old.rounding(name, given))
        settled = _nearest(known, given, rounding)
        if (settled == given).all() or len(settled) > LONGEST_LIST:
            continue
        if name in axes:
            axes[name] = settled.tolist()
        elif name in cases:
            cases[name] = settled.tolist()
        else:
            constants[name] = float(settled[0])
    return new.model_copy(update={"constants": constants, "axes": axes, "cases": cases})


def _nearest(known: np.ndarray, given: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """`given`, each value replaced by a known one within `rounding`; values that differ stay so."""
    known = np.unique(known)
    after = np.searchsorted(known, given).clip(0, len(known) - 1)
    pair = known[np.stack([(after - 1).clip(0), after])]
    nearest = np.where(abs(pair[0] - given) < abs(pair[1] - given), *pair)
    settled = np.where(abs(nearest - given) <= rounding, nearest, given)
    return settled if len(np.unique(settled)) == len(np.unique(given)) else given


def _differences(store: Store, new: Sweep) -> Iterator[str]:
    """What must be equal in both sweeps and differs."""
    old = store.grid.sweep
    if old.reduce or new.reduce:
        yield "`reduce` can't be extended: a larger sweep runs into a store of its own."
        return
    if new.precision and f"float{new.precision}" != store.dtype:
        yield f"`precision` must be that of the store, {store.dtype.removeprefix('float')}."
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
    """What the store has and the larger sweep lacks."""
    before, after = old.sweep.held(), new.sweep.held()
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
        present = set(_places(old, new, dim).tolist()) - {-1}
        lost = sorted(set(range(old.dims.get(dim, 1))) - present)
        if lost and dim in old.dims:
            values = ", ".join(f"{n} = {v[lost[0]]}" for n, v in known.items())
            yield f"`{dim}` must keep what the store has, but lacks {values}."
        elif lost:
            values = ", ".join(f"{n} = {before[n]}" for n in here)
            yield f"`{dim}` must contain {values}, which the store was run with."


def _along(grid: Grid, dim: str) -> dict[str, np.ndarray]:
    """Fields and choices that vary along a dimension; empty if the grid lacks it."""
    if dim not in grid.dims:
        return {}
    if dim == "scenario":  # by number: the same sample gives the same scenarios
        return {dim: np.arange(grid.dims[dim])}
    return {name: v for name, v in grid.coordinates(dim).items() if name != "case"}


def _places(old: Grid, new: Grid, dim: str) -> np.ndarray:
    """For each place along a dimension of the new grid, the place in the old one, or -1."""
    values, known, constants = _along(new, dim), _along(old, dim), old.sweep.held()
    same = np.ones(new.dims[dim], bool)
    for name in values.keys() - known.keys():
        same &= values[name] == constants[name]
    if not known:
        return np.where(same, 0, -1)
    keys = list(zip(*(known[name].tolist() for name in known), strict=True))
    index = {key: i for i, key in enumerate(keys)}
    asked = zip(*(values[name].tolist() for name in known), strict=True)
    # equal cases: each stays in its own place
    places = [i if keys[i : i + 1] == [key] else index.get(key, -1) for i, key in enumerate(asked)]
    return np.where(same, places, -1)


@dataclass(frozen=True)
class _Map:
    """Where the cells of a larger grid are in the store."""

    places: list[np.ndarray]  # for each dimension of the larger grid: place in the store, or -1
    axes: list[int]  # for each dimension of the store: its number in the larger grid
    has_row: np.ndarray  # blocks of the store


def _blocks_with_known_cells(store: Store, grid: Grid) -> Iterator[tuple[Values, Row]]:
    """Each block of the larger grid that has a cell of the store."""
    has_row = np.zeros(store.grid.counts, bool)
    has_row.flat[[row.block for row in store.rows()]] = True
    dims = list(grid.dims)
    places = [_places(store.grid, grid, dim) for dim in dims]
    map_ = _Map(places, [dims.index(dim) for dim in store.grid.dims], has_row)
    for index in range(grid.n_blocks):
        values = _gather(store, grid, index, map_)
        if values is not None:
            known = np.isin(values["status"], (OK, DIVERGED))
            if known.any():
                yield values, Row(index, DONE if known.all() else PARTLY)


def _gather(store: Store, grid: Grid, index: int, map_: _Map) -> Values | None:
    """A block of the larger grid with the store's numbers; None if the store has none of it."""
    block = grid.block(index)
    parts = [places[part] for places, part in zip(map_.places, block, strict=True)]
    inside = [np.flatnonzero(part >= 0) for part in parts]
    if not all(len(i) for i in inside):
        return None
    source = [parts[axis][inside[axis]] for axis in map_.axes]  # per dimension of the store
    shape = shape_of(block)
    sides = [part // side for part, side in zip(source, store.grid.block_shape, strict=True)]

    def spread(found: np.ndarray) -> np.ndarray:
        """From the store's dimensions to those of the larger grid, for broadcasting."""
        ordered = np.transpose(found, np.argsort(map_.axes))
        lengths = iter(ordered.shape)
        return ordered.reshape([next(lengths) if i in map_.axes else 1 for i in range(len(shape))])

    found = {n: spread(np.asarray(store.array(n).oindex[tuple(source)])) for n in store.variables}
    known = spread(map_.has_row[np.ix_(*sides)]) & np.isin(found["status"], (OK, DIVERGED))
    values = no_values(grid, index)
    for name in store.variables:
        whole = values[name].reshape(shape)  # a view
        whole[np.ix_(*inside)] = np.where(known, found[name], whole.flat[0])
    return values
