"""Maps of a store: its axes, its metrics, the rest cut or reduced; a running sweep fills in."""

import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fic_jax import CHOICES, QUANTITIES
from sweeps import maps
from sweeps.explore import texts
from sweeps.explore.cells import (
    REASONS,
    Axis,
    Doubt,
    Map,
    Row,
    label,
    printed,
    reasons,
    row,
    text,
    unit,
)
from sweeps.explore.motion import Scenario
from sweeps.explore.source import Stage
from sweeps.explore.view import HOWS, How, Space, Value, View, with_axes, written
from sweeps.explore.worker import Stale
from sweeps.spec.mistakes import SweepError, command
from sweeps.spec.types import Reduction, Sweep
from sweeps.store.format import (
    DIVERGED,
    DIVERGED_NEAR,
    ERRORS,
    FAILED,
    FLAGS,
    JUDGEMENTS,
    LEVEL,
    NEAR,
    NOT_RUN,
    NOT_TRUSTED,
    OK,
    OK_NEAR,
    OLD_JUDGEMENTS,
    TRUSTED,
    UNTRUSTED,
)
from sweeps.store.opening import open_store

if TYPE_CHECKING:
    import xarray as xr

MOST_HELD = 50_000_000  # values of a variable in memory: 200 MB in float32
MOST_LISTED = 2_000  # values of a dimension that a slider has
NEVER = ""  # when a block was loaded that was not
LATEST = 3  # metrics in memory, with their flags
LOAD = 0.3  # s after a map, when nothing else is to be done
POLL = 1.0  # s between two looks at a running sweep
STATUS = {
    NOT_RUN: "not run",
    DIVERGED: "diverged",
    FAILED: "failed",
    UNTRUSTED: "not trusted",
}


class Variable:
    """A variable of a store in memory, block by block as they are needed."""

    def __init__(self, shape: tuple[int, ...], dtype: Any) -> None:
        self.values = np.empty(shape, dtype)  # memory that no block needs yet costs no time
        self.fill = 0 if np.dtype(dtype).kind == "u" else np.nan
        self.loaded: dict[int, str | None] = {}  # block -> when it was committed; None: not yet


class Stored:
    """Maps of a store. Raises SweepError for one that has no map, with what to use instead."""

    no_motion = "A cell of a reduced store is many scenarios, and has no motion."

    def __init__(self, path: Path) -> None:
        store = open_store(path)
        grid = store.grid
        shown = Path(str(path))
        if grid.sweep.sample and "scenario" in grid.dims:
            first, second = [*grid.sweep.sample.ranges, *QUANTITIES][:2]
            instead = command("plot", shown, "--x", first, "--y", second)
            raise SweepError(f"{path}: is a random design, which has no axes; {instead} draws dots")
        if len(grid.dims) < 2:
            (dim,) = grid.dims
            instead = command("plot", shown, "--x", dim)
            raise SweepError(f"{path}: has one dimension, and a map needs two; {instead} draws it")
        store.check_metadata()
        store.check_done()
        self.store, self.grid, self.path = store, grid, Path(path).absolute()
        self.dtype = store.dtype
        self.has_motion = grid.sweep.reduce is None
        self._variables: dict[str, Variable] = {}
        self._done: dict[int, str] = {}
        self._next_poll = 0.0
        self.version = 0  # changes with the blocks that are done
        self.title = grid.sweep.description or grid.sweep.name
        self.poll()
        if self.space.metrics == ():
            raise SweepError(f"{path}: has no metric to show")

    @property
    def running(self) -> bool:
        """Whether blocks are still to come."""
        return len(self._done) < len(self.grid.own)

    def poll(self) -> None:
        """Look for new blocks, in a twentieth of the time at most."""
        began = time.monotonic()
        if began < self._next_poll:
            return
        done = {row.block: row.at for row in self.store.rows()}
        took = time.monotonic() - began
        self._next_poll = began + max(0.9 * POLL, 20 * took)
        self.version += done != self._done
        self._done = done

    @cached_property
    def coordinates(self) -> dict[str, NDArray[Any]]:
        """The values of each dimension, in the order of the store."""
        return {dim: np.asarray(self.grid.coordinates(dim)[dim]) for dim in self.grid.dims}

    @cached_property
    def axes(self) -> dict[str, Axis]:
        """Each dimension as the side of a map, its values ascending."""
        found = {}
        for dim, values in self.coordinates.items():
            scale = maps.scale_of(values, dim)
            ordered = np.sort(values) if scale != "category" else values
            found[dim] = Axis(dim, scale, ordered)
        return found

    @cached_property
    def space(self) -> Space:
        words = {d: tuple(map(str, v)) for d, v in self.coordinates.items() if v.dtype.kind == "U"}
        numbers = tuple(dim for dim in self.coordinates if dim not in words)
        dims = tuple(self.coordinates)
        reducible = dims if self.has_motion and self.grid.cells <= MOST_HELD else ()
        metrics = tuple(
            name
            for name in self.store.variables
            if name not in (*FLAGS, LEVEL) and "flag_values" not in self.store.array(name).attrs
        )
        return Space(metrics, numbers, words, dims, reducible, live=False)

    @cached_property
    def defaults(self) -> dict[str, Value]:
        """The middle of each dimension."""
        return {dim: axis.value(len(axis.values) // 2) for dim, axis in self.axes.items()}

    @property
    def start(self) -> View:
        """The two numeric axes with most values, the first upright, and the rest at its middle."""
        dims = self.grid.dims
        words = {*self.space.words, "case"}
        two = sorted(dims, key=lambda dim: (dim in words, -dims[dim]))[:2]
        y, x = sorted(two, key=lambda dim: (dim in words, [*dims].index(dim)))
        metrics = self.space.metrics
        by = [name for name in metrics if name.endswith("_at_best")]
        metric = "nmse" if "nmse" in metrics else (*by, *metrics)[0]
        return View(metric, x, y, self.defaults)

    def opened(self, view: View) -> View:
        """The view of an address at the nearest values that were run."""

        def run(name: str, value: Value) -> Value:
            axis = self.axes[name]
            return axis.value(axis.index(value))

        at = {name: run(name, value) for name, value in view.at.items()}
        pins = tuple({name: run(name, value) for name, value in p.items()} for p in view.pins)
        cell = view.cell and (run(view.x, view.cell[0]), run(view.y, view.cell[1]))
        return replace(view, at=at, pins=pins, cell=cell)

    def moved(self, view: View, name: str, value: Value) -> View:
        """The view at another value of a dimension: the nearest that was run."""
        axis = self.axes[name]
        return replace(view, at={**view.at, name: axis.value(axis.index(value))})

    def with_axis(self, view: View, side: str, name: str) -> View:
        """The view with another axis; two axes that would be the same change places."""
        view = with_axes(view, side, name)
        return replace(view, over=tuple(d for d in view.over if d not in (view.x, view.y)))

    def level(self, view: View) -> float:
        """The largest value of the metric that counts in a share."""
        if view.level is not None:
            return view.level
        times = maps.LINEAR_METRICS
        end = self.grid.sweep.time.t_end if view.metric in times else 0.0
        return maps.LEVELS.get(view.metric, end)

    def check(self, view: View) -> None:
        """Any view of the space can be shown."""

    def stages(self) -> list[Stage]:
        """What computes a map: one step. Then blocks are loaded: no slider waits for the disk."""
        return [(0.0, lambda view, _, stale: self.map(view, stale)), (LOAD, self._load)]

    def _load(self, view: View, _: Map | None, stale: Stale) -> None:
        """Load all blocks of what a map needs, unless a newer view needs others first."""
        if self.grid.cells > MOST_HELD:
            return
        for name in self._needed(view.metric):
            side = self.grid.block_shape[0]
            for first in range(0, self.grid.shape[0], side):
                if stale():
                    return
                rest = [slice(None)] * (len(self.grid.dims) - 1)
                self._read(name, (slice(first, min(first + side, self.grid.shape[0])), *rest))

    def _needed(self, metric: str) -> list[str]:
        """The variables that a map of a metric reads."""
        names = [metric, str(self.store.array(metric).attrs.get("ancillary_variables", ""))]
        names += [self._flag(metric), "status", "convergence_time"]
        return [name for name in names if name in self.store.variables]

    def _flag(self, metric: str) -> str:
        """The flag that says whether a metric is trusted; empty if the store has none."""
        judged = ERRORS.get(metric, metric)
        flags = [n for n, of in (JUDGEMENTS | OLD_JUDGEMENTS).items() if of == judged]
        return next((name for name in flags if name in self.store.variables), "")

    def map(self, view: View, stale: Stale = lambda: False) -> Map | None:
        """The map of a view; None if it became stale meanwhile."""
        del stale
        array = self.store.array(view.metric)
        values = self._cells(view.metric, view)
        own = str(array.attrs.get("ancillary_variables", ""))
        status = self._cells("status", view)
        for code, meant in ((OK_NEAR, OK), (DIVERGED_NEAR, DIVERGED)):  # of a refined store
            status = np.where(status == code, np.uint8(meant), status)
        if own:
            status = np.where(status == OK, self._cells(own, view), status)
        flag = self._flag(view.metric)
        untrusted = self._cells(flag, view) == NOT_TRUSTED if flag else None
        converged = None
        if self.has_motion and "convergence_time" in self.store.variables:
            converged = np.isfinite(self._cells("convergence_time", view))
        label, unit = str(array.attrs["long_name"]), printed(str(array.attrs["units"]))
        if view.over:
            gone = tuple(range(2, values.ndim))
            values = reduced(values, status, gone, view, self.level(view))
            status = worst_status(status, gone, view.how)
            untrusted = None if untrusted is None else untrusted.any(gone)
            converged = None if converged is None else converged.all(gone)
            label, unit = self._reduced_label(view, label, unit)
        y, x = self.axes[view.y], self.axes[view.x]
        doubt = None if untrusted is None else Doubt(untrusted, x.places, y.places)
        return Map(
            view=view,
            x=x,
            y=y,
            values=values,
            reasons=reasons(values, status, STATUS),
            label=label,
            unit=unit,
            converged=converged,
            doubt=doubt,
        )

    def _reduced_label(self, view: View, label: str, unit: str) -> tuple[str, str]:
        over = ", ".join(view.over)
        if view.how == "share":
            return f"share of cells with {view.metric} ≤ {self.level(view):g}, over {over}", ""
        return f"{view.how} {label} over {over}", unit

    def _cells(self, name: str, view: View) -> NDArray[Any]:
        """A variable [y, x, reduced dimensions], the rest cut."""
        index: list[int | slice] = []
        for dim, values in self.coordinates.items():
            if dim in (view.x, view.y, *view.over):
                index.append(slice(None))
            else:
                index.append(self._position(dim, values, view.at[dim]))
        cells = self._read(name, tuple(index))
        stay = [dim for dim, i in zip(self.coordinates, index, strict=True) if isinstance(i, slice)]
        order = [view.y, view.x, *(dim for dim in stay if dim in view.over)]
        cells = cells.transpose([stay.index(dim) for dim in order])
        for side, dim in enumerate((view.y, view.x)):
            values = self.coordinates[dim]
            if self.axes[dim].scale != "category" and np.any(np.diff(values) < 0):
                cells = np.take(cells, np.argsort(values), axis=side)
        return cells

    def _position(self, dim: str, values: NDArray[Any], value: Value) -> int:
        """The index of a value along a dimension, in the order of the store."""
        nearest = self.axes[dim].value(self.axes[dim].index(value))
        if isinstance(nearest, str):
            return values.tolist().index(nearest)
        return int(np.argmin(np.abs(values.astype(float) - nearest)))

    def _read(self, name: str, index: tuple[int | slice, ...]) -> NDArray[Any]:
        """A part of a variable: from memory, where blocks are loaded as they are needed."""
        if self.grid.cells > MOST_HELD:
            return np.asarray(self.store.array(name)[index])
        variable = self._variables.get(name)
        if variable is None:
            dtype = self.store.array(name).dtype
            variable = self._variables[name] = Variable(self.grid.shape, dtype)
            self._forget()
        blocks = {block: self._done.get(block) for block in self._blocks(index)}
        new = [b for b, when in blocks.items() if variable.loaded.get(b, NEVER) != when]
        if new and all(blocks.values()):
            box = self._box(index)  # one call, where a call for each block takes four times as long
            variable.values[box] = self.store.array(name)[box]
        else:
            for block in new:
                part = self.grid.block(block)
                done = blocks[block] is not None
                variable.values[part] = self.store.array(name)[part] if done else variable.fill
        variable.loaded |= blocks
        return variable.values[index]

    def _forget(self) -> None:
        """Drop the metrics that were loaded longest ago."""
        own = {"status", "convergence_time"}
        metrics = [n for n in self._variables if n not in own and n not in FLAGS]
        for name in metrics[:-LATEST]:
            self._variables.pop(name, None)

    def _places(self, index: tuple[int | slice, ...]) -> list[range]:
        """The blocks that a part of the cells lies in, along each dimension."""
        sides = zip(index, self.grid.block_shape, self.grid.counts, strict=True)
        return [
            range((i.start or 0) // side, n if i.stop is None else -(-i.stop // side))
            if isinstance(i, slice)
            else range(i // side, i // side + 1)
            for i, side, n in sides
        ]

    def _blocks(self, index: tuple[int | slice, ...]) -> Iterator[int]:
        """The numbers of the blocks that a part of the cells lies in."""
        for place in itertools.product(*self._places(index)):
            yield int(np.ravel_multi_index(place, self.grid.counts))

    def _box(self, index: tuple[int | slice, ...]) -> tuple[slice, ...]:
        """All cells of the blocks that a part of the cells lies in."""
        sides = zip(self._places(index), self.grid.block_shape, self.grid.shape, strict=True)
        return tuple(slice(p.start * side, min(p.stop * side, n)) for p, side, n in sides)

    def place(self, view: View) -> dict[str, Value] | None:
        """What the selected cell is at; of a worst case, the cell that is the worst."""
        place = view.place()
        if place is None or not view.over or view.how != "worst":
            return place
        index = [
            slice(None) if dim in view.over else self._position(dim, values, place[dim])
            for dim, values in self.coordinates.items()
        ]
        cells = self._read(view.metric, tuple(index))
        worst = np.unravel_index(_farthest(cells.ravel(), view.metric), cells.shape)
        dims = [dim for dim in self.coordinates if dim in view.over]
        for dim, i in zip(dims, worst, strict=True):
            value = self.coordinates[dim][i]
            place[dim] = str(value) if dim in self.space.words else float(value)
        return place

    def scenario(self, place: Mapping[str, Value]) -> Scenario:
        """The scenario of a cell."""
        return Scenario.of(self.grid, self._cell(place), self.dtype)

    def _cell(self, place: Mapping[str, Value]) -> tuple[slice, ...]:
        index = [self._position(dim, v, place[dim]) for dim, v in self.coordinates.items()]
        return tuple(slice(i, i + 1) for i in index)

    def values(self, place: Mapping[str, Value], known: Mapping[str, float]) -> list[Row]:
        """The metrics of a cell, as the store has them, in rows of text."""
        del known
        cell, rows = self._cell(place), []
        for name in self.space.metrics:
            array = self.store.array(name)
            value = float(np.asarray(array[cell]).reshape(()))
            rows.append(row(name, value, str(array.attrs["units"])))
        return rows

    def disagreement(
        self, place: Mapping[str, Value], rows: list[Row], computed: Mapping[str, float]
    ) -> str:
        """What to say if this program computes another nmse than the store has; or nothing."""
        status = np.asarray(self.store.array("status")[self._cell(place)])
        if status.item() in NEAR.values():
            return "This cell was not simulated: the store has the values of one beside it."
        stored = {name: float(exact) for name, _, _, exact in rows}
        nmse, found = stored.get("nmse", np.nan), computed["nmse"]
        if np.isnan(nmse) or nmse == found:
            return ""
        return (
            f"The store has nmse = {nmse:.6g}, this program computes {found:.6g}: another version "
            "or another processor wrote the store."
        )

    def controls(self) -> dict[str, Any]:
        """What the page's controls are."""
        dims = []
        for dim, axis in self.axes.items():
            few = len(axis.values) <= MOST_LISTED
            values = [written(axis.value(i)) for i in range(len(axis.values))] if few else []
            shown = [text(axis.value(i)) for i in range(len(values))]
            about = QUANTITIES.get(dim, {"meaning": f"{dim} of the sweep"})
            names = {"name": dim, "label": label(dim), "meaning": about["meaning"]}
            dims.append(names | {"unit": unit(dim), "values": values, "texts": shown})
        arrays = {name: self.store.array(name).attrs for name in self.space.metrics}
        return {
            "live": False,
            "metrics": [[name, f"{name}: {attrs['long_name']}"] for name, attrs in arrays.items()],
            "axes": [[dim["name"], f"{dim['name']}: {dim['meaning']}"] for dim in dims],
            "dims": dims,
            "hows": HOWS if self.space.reducible and len(dims) > 2 else (),
        }

    def plan(self, view: View) -> Sweep:
        """The part of its sweep that a view shows."""
        sweep = self.grid.sweep
        shown = {view.x, view.y, *view.over, *(sweep.reduce.gone if sweep.reduce else ())}
        cut = {dim: view.at[dim] for dim in self.grid.dims if dim not in shown}
        place = {
            dim: self.coordinates[dim][self._position(dim, self.coordinates[dim], value)]
            for dim, value in cut.items()
        }
        constants = dict(sweep.constants)
        constants |= {dim: float(v) for dim, v in place.items() if dim in sweep.axes}
        cases = sweep.cases
        if "case" in place:
            constants |= {name: column[int(place["case"])] for name, column in cases.items()}
            cases = {}
        model = sweep.model | {dim: str(v) for dim, v in place.items() if dim in CHOICES}
        changes: dict[str, Any] = {
            "name": "explored",
            "constants": constants,
            "cases": cases,
            "model": model,
            "axes": {name: axis for name, axis in sweep.axes.items() if name not in place},
            "precision": 64 if self.dtype == "float64" else None,
        }
        if view.over:
            changes["reduce"] = _reduction(view, self.level(view))
        return sweep.model_copy(update=changes)

    def cut(self, view: View) -> tuple[str, ...]:
        """The dimensions that `dataset` has and the map does not."""
        shown = self.grid.dims if view.over else (view.x, view.y)
        return tuple(dim for dim in self.grid.dims if dim not in shown)

    def sweep_file(self, view: View) -> str:
        """The part of its sweep that a view shows, as a file."""
        return texts.sweep_file(self.plan(view))

    def python(self, view: View) -> str:
        """Python that reads a view's cells."""
        rest = [dim for dim in self.grid.dims if dim not in (view.x, view.y, *view.over)]
        at = {dim: self._position(dim, self.coordinates[dim], view.at[dim]) for dim in rest}
        return texts.python_of_store(self.path, view, at, self.level(view))

    def dataset(self, view: View) -> "xr.Dataset":
        """A view's cells with their flags, as a part of the store or reduced."""
        from sweeps.store.opening import dataset

        data = dataset(self.path)
        if not view.over:
            return data
        found = self.map(view)
        assert found
        index = {
            dim: self._position(dim, self.coordinates[dim], view.at[dim])
            for dim in self.grid.dims
            if dim not in (view.x, view.y, *view.over)
        }
        part = data[["status"]].isel(index).isel(dict.fromkeys(view.over, 0), drop=True)
        part = part.sortby([d for d in (view.x, view.y) if self.axes[d].scale != "category"])
        codes = {"": OK, "infinite": OK, "no value": OK} | {r: c for c, r in STATUS.items()}
        lookup = np.array([codes[reason] for reason in REASONS], np.uint8)
        part["status"] = ((view.y, view.x), lookup[found.reasons])
        attributes = {"units": found.unit, "long_name": found.label}
        part[view.metric] = ((view.y, view.x), found.values, attributes)
        flag = f"{view.metric}_trusted"
        if found.doubt is not None and flag in data:
            trust = np.where(found.doubt.untrusted, np.uint8(NOT_TRUSTED), np.uint8(TRUSTED))
            part[flag] = ((view.y, view.x), trust, data[flag].attrs)
        return part


def reduced(
    values: NDArray[Any], status: NDArray[Any], gone: tuple[int, ...], view: View, level: float
) -> NDArray[Any]:
    """A statistic over the last dimensions; of a signed metric the worst is the farthest from 0."""
    if view.how == "share":
        return np.asarray(np.mean((status == OK) & (values <= level), gone))
    if view.how == "mean":
        return np.asarray(np.mean(values, gone, dtype=np.float64))
    if view.how == "median":
        return np.asarray(np.quantile(values, 0.5, gone, method="inverted_cdf"))
    flat = values.reshape(*values.shape[:2], -1)
    return np.asarray(np.take_along_axis(flat, _farthest(flat, view.metric)[..., None], -1)[..., 0])


def _farthest(values: NDArray[Any], metric: str) -> NDArray[np.intp]:
    """The index of the worst value along the last dimension, or of the first without a number."""
    return np.asarray(np.argmax(np.abs(values) if metric in maps.SIGNED_METRICS else values, -1))


def worst_status(status: NDArray[Any], gone: tuple[int, ...], how: How) -> NDArray[Any]:
    """What became of all cells of a statistic. In a share, a diverged one is one that fails."""
    found = np.full(status.shape[:2], OK, status.dtype)
    for code in (DIVERGED, FAILED, NOT_RUN):
        if not (how == "share" and code == DIVERGED):
            found[(status == code).any(gone)] = code
    return found


def _reduction(view: View, level: float) -> Reduction:
    # the map has the numbers of cells that are not trusted, and hatches them
    over, metric = list(view.over), view.metric
    if view.how == "mean":
        return Reduction(over=over, untrusted=1.0, mean=[metric])
    if view.how == "median":
        return Reduction(over=over, untrusted=1.0, quantiles={metric: [0.5]})
    if view.how == "share":
        return Reduction(over=over, untrusted=1.0, share={"within": f"{metric} <= {level!r}"})
    signed = metric in maps.SIGNED_METRICS
    return Reduction(over=over, untrusted=1.0, max=[metric], min=[metric] if signed else [])
