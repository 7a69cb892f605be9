"""The statistics of a block of a reduced store.

A statistic is over the scenarios that ran and did not diverge. The others, and those that are not
trusted for a metric that the statistic needs, are counted by kind; too many refuse the value.
"""

import itertools
import math
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fic_jax import QUANTITIES
from sweeps.plan.grid import LARGEST_BLOCK, Block, Grid, cells_of, shape_of
from sweeps.spec.condition import holds, names
from sweeps.spec.types import Reduction, Sweep
from sweeps.store.commit import Values
from sweeps.store.format import DIVERGED, NOT_RUN, OK, TRUSTED, UNTRUSTED
from sweeps.store.reduced import conditions, place_values, quantile

Cells = Callable[[Block], Values]  # a box of scenarios -> metrics and flags, in storage order
Rows = np.ndarray  # [cells of a box that stay, combinations of those that go]


def block_values(grid: Grid, block: Block, cells: Cells) -> Values:
    """The variables of a block, from its scenarios.

    `cells` is called with boxes of `grid.full`, each of one model and of LARGEST_BLOCK scenarios at
    most, in an order that the sweep alone decides. If there are several, it is called from another
    thread: a box is computed while the one before is reduced, which takes a GPU's host as long.
    """
    reduce = grid.sweep.reduce
    assert reduce
    stay = dict(zip(grid.dims, block, strict=True))
    if reduce.best:
        stay[reduce.best] = slice(0, grid.candidates)
    shape = shape_of(tuple(stay.values()))
    found: dict[str, np.ndarray] = {}
    boxes = list(_boxes(grid, stay, LARGEST_BLOCK // math.prod(_sides(grid))))
    parts = list(_boxes(grid, _whole(grid), math.prod(_sides(grid))))
    scenarios = [_scenarios(grid, box, part) for box in boxes for part in parts]
    with closing(_ahead(cells, scenarios)) as values:
        for box in boxes:
            at = tuple(_shifted(part, -stay[dim].start) for dim, part in box.items())
            for name, statistic in _statistics(grid, box, parts, values).items():
                whole = found.setdefault(name, np.empty(shape, statistic.dtype))
                whole[at] = statistic.reshape(shape_of(at))
    rows = {name: v.reshape(cells_of(block), -1) for name, v in found.items()}
    return _chosen(grid, reduce, rows)


def variables_read(sweep: Sweep) -> list[str]:
    """The variables of scenarios that the statistics of a sweep need."""
    metrics = list(dict.fromkeys(m for needed in _needs(sweep).values() for m in needed))
    flags = [f"{metric}_trusted" for metric in metrics if sweep.error_estimate]
    return [*metrics, *flags, "status"]


def _needs(sweep: Sweep) -> dict[str, list[str]]:
    """The metrics that each metric or condition of a reduction needs."""
    assert sweep.reduce
    return {m: [m] for m in sweep.reduce.metrics} | conditions(sweep.reduce, sweep.metrics)


def _shifted(part: slice, by: int) -> slice:
    return slice(part.start + by, part.stop + by)


def _sides(grid: Grid) -> tuple[int, ...]:
    """Sides of a box along the dimensions that statistics are over: the same for any block."""
    return grid.halved(_over(grid), LARGEST_BLOCK)


def _over(grid: Grid) -> dict[str, int]:
    """The dimensions that statistics are over, in the order of the sweep."""
    assert grid.sweep.reduce
    dims = grid.full.dims
    return {dim: n for dim, n in dims.items() if dim in grid.sweep.reduce.over}


def _boxes(grid: Grid, within: Mapping[str, slice], most: int) -> Iterator[dict[str, slice]]:
    """Parts of a box, each of at most `most` cells and of one model."""
    sides = grid.halved({dim: p.stop - p.start for dim, p in within.items()}, max(most, 1))
    stretches = [
        [slice(i, min(i + side, part.stop)) for i in range(part.start, part.stop, side)]
        for part, side in zip(within.values(), sides, strict=True)
    ]
    return (dict(zip(within, box, strict=True)) for box in itertools.product(*stretches))


def _whole(grid: Grid) -> dict[str, slice]:
    """All values of the dimensions that statistics are over."""
    return {dim: slice(0, length) for dim, length in _over(grid).items()}


def _scenarios(grid: Grid, box: Mapping[str, slice], part: Mapping[str, slice]) -> Block:
    """The box of `grid.full` with some cells and a part of their combinations."""
    both = {**box, **part}
    return tuple(both[dim] for dim in grid.full.dims)


def _ahead(cells: Cells, boxes: Sequence[Block]) -> Generator[Values]:
    """What `cells` gives for each box; the next one is computed while the last one is used."""
    if len(boxes) == 1:  # in a thread of its own it would take twice the memory, and no less time
        yield cells(boxes[0])
        return
    pool, last = ThreadPoolExecutor(1), None
    try:
        for box in boxes:
            before, last = last, pool.submit(cells, box)
            if before:
                yield before.result()
        if last:
            yield last.result()
    finally:  # after an error, only what is running is waited for
        pool.shutdown(cancel_futures=True)


def _statistics(
    grid: Grid,
    box: Mapping[str, slice],
    parts: Iterable[Mapping[str, slice]],
    boxes: Iterator[Values],
) -> dict[str, np.ndarray]:
    """All that the scenarios of some cells say, by name: arrays [cells of the box].

    `boxes` gives the variables of each part of their combinations in turn.
    """
    reduce, sweep = grid.sweep.reduce, grid.sweep
    assert reduce
    over, dims = _over(grid), list(grid.full.dims)
    order = [dims.index(dim) for dim in (*box, *over)]
    n = math.prod(part.stop - part.start for part in box.values())
    needs = _needs(sweep)
    in_conditions = {one for text in reduce.share.values() for one in names(text)}
    total = Totals(reduce, math.prod(over.values()), list(needs))
    for part in parts:
        values = next(boxes)
        scenarios = _scenarios(grid, box, part)
        shape = shape_of(scenarios)

        def rows(column: np.ndarray, shape: tuple[int, ...] = shape) -> Rows:
            """[scenarios in storage order] -> [cells that stay, combinations].

            Each row lies in one piece: numpy's order of summation depends on it.
            """
            return np.ascontiguousarray(column.reshape(shape).transpose(order).reshape(n, -1))

        named: dict[str, Any] = {name: rows(values[name]) for name in variables_read(sweep)}
        if fields := in_conditions & QUANTITIES.keys():
            params = vars(grid.full.params(scenarios))
            named |= {k: rows(params[k]) if params[k].ndim else params[k] for k in fields}
        total.count(named["status"])
        for name, metrics in needs.items():
            used = named["status"] == OK
            for metric in metrics:
                used &= ~np.isnan(named[metric])
            known = used.copy()
            for metric in metrics if sweep.error_estimate else ():
                known &= named[f"{metric}_trusted"] == TRUSTED
            total.judge(name, used, known)
            if name in reduce.share:
                total.hold(name, used & holds(reduce.share[name], named))
            else:
                total.fold(name, named[name], used, _places(over, part))
    return total.results()


def _places(over: Mapping[str, int], part: Mapping[str, slice]) -> np.ndarray:
    """The numbers of a box's combinations among all, in their order."""
    along = np.ix_(*(np.arange(stretch.start, stretch.stop) for stretch in part.values()))
    return np.ravel_multi_index(along, tuple(over.values())).ravel()


@dataclass
class Totals:
    """Counts, extremes and moments of n cells, box by box."""

    reduce: Reduction
    combinations: int  # scenarios of each
    names: list[str]  # metrics and conditions
    counts: dict[str, np.ndarray] = field(default_factory=dict)  # [n] each
    extremes: dict[str, np.ndarray] = field(default_factory=dict)
    places: dict[str, np.ndarray] = field(default_factory=dict)  # of the extremes
    sums: dict[str, np.ndarray] = field(default_factory=dict)
    squares: dict[str, np.ndarray] = field(default_factory=dict)  # of deviations from the mean
    held: dict[str, list[np.ndarray]] = field(default_factory=dict)  # values, for quantiles

    def _add(self, name: str, there: Rows) -> None:
        self.counts[name] = self.counts.get(name, 0) + there.sum(axis=1)

    def count(self, status: Rows) -> None:
        """Add scenarios by their status."""
        self._add("ran", status == OK)
        self._add("diverged", status == DIVERGED)

    def judge(self, name: str, used: Rows, known: Rows) -> None:
        """Add the scenarios that have a value of a metric or condition, and the trusted ones."""
        self._add(f"{name} used", used)
        self._add(f"{name} known", known)

    def hold(self, name: str, true: Rows) -> None:
        """Add the scenarios for which a condition holds."""
        self._add(f"{name} true", true)

    def fold(self, metric: str, values: Rows, used: Rows, places: np.ndarray) -> None:
        """Add the values of a metric, at `places` among all combinations."""
        reduce = self.reduce
        if metric in reduce.max or metric == reduce.by:
            self._extreme(f"{metric}_max", -values, used, places)
        if metric in reduce.min:
            self._extreme(f"{metric}_min", values, used, places)
        if metric in (*reduce.mean, *reduce.std):
            self._moments(metric, values, used)
        if metric in reduce.quantiles:
            self.held.setdefault(metric, []).append(np.where(used, values, np.nan))

    def _extreme(self, name: str, values: Rows, used: Rows, places: np.ndarray) -> None:
        """The smallest value and its first place; the order of the boxes does not matter."""
        least = np.where(used, values, np.inf)
        first = np.argmin(least, axis=1)
        lowest = np.take_along_axis(least, first[:, None], 1)[:, 0]
        infinite = np.isposinf(lowest)  # then the first used one is as small as any
        first = np.where(infinite, np.argmax(used, axis=1), first)
        # no place, beyond all others, where nothing is used
        place = np.where(used.any(axis=1), places[first], self.combinations)
        if name in self.extremes:
            before, there = self.extremes[name], self.places[name]
            earlier = (before < lowest) | ((before == lowest) & (there < place))
            lowest, place = np.where(earlier, before, lowest), np.where(earlier, there, place)
        self.extremes[name], self.places[name] = lowest, place

    def _moments(self, metric: str, values: Rows, used: Rows) -> None:
        """Sums of a box in double precision, merged as by Chan, Golub and LeVeque (1979)."""
        n_before = self.counts[f"{metric} used"] - used.sum(axis=1)
        n = used.sum(axis=1)
        x = np.where(used, values, 0).astype(np.float64)
        total = x.sum(axis=1)
        if metric in self.reduce.std:
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                deviation = np.where(used, x - (total / n)[:, None], 0.0)
                squares = (deviation**2).sum(axis=1)
                if metric in self.sums:
                    apart = total / n - self.sums[metric] / n_before
                    both = np.where((n > 0) & (n_before > 0), n * n_before, 0) / (n + n_before)
                    squares += self.squares[metric] + np.where(both > 0, apart**2 * both, 0.0)
            self.squares[metric] = squares
        self.sums[metric] = self.sums.get(metric, 0.0) + total

    def results(self) -> dict[str, np.ndarray]:
        """The statistics, not yet refused: NaN where nothing is known."""
        reduce, counts, out = self.reduce, self.counts, dict[str, np.ndarray]()
        ran, diverged = counts["ran"], counts["diverged"]
        absent = self.combinations - ran - diverged
        out["diverged_share"] = diverged / self.combinations
        out["not_run_share"] = absent / self.combinations
        for name in self.names:
            known = counts[f"{name} known"]
            doubted = ran - known
            out[f"{name}_untrusted_share"] = doubted / self.combinations
            kinds = np.array([DIVERGED, UNTRUSTED, NOT_RUN])
            most = kinds[np.argmax([diverged, doubted, absent], axis=0)]
            missing = self.combinations - known
            used = counts[f"{name} used"]
            refused = (missing > reduce.untrusted * self.combinations) | (used == 0)
            out[f"{name}_status"] = np.where(refused, most, OK).astype(np.uint8)
        with np.errstate(invalid="ignore", divide="ignore"):
            for name in reduce.share:
                out[f"{name}_share"] = counts[f"{name} true"] / counts[f"{name} used"]
            for metric, total in self.sums.items():
                used = counts[f"{metric} used"]
                out[f"{metric}_mean"] = total / used
                if metric in self.squares:
                    spread = np.sqrt(self.squares[metric] / used)
                    # a value that is infinite is infinitely far from the others
                    out[f"{metric}_std"] = np.where(np.isinf(total), np.inf, spread)
        for name, lowest in self.extremes.items():
            nowhere = self.places[name] == self.combinations
            value = -lowest if name.endswith("_max") else lowest
            out[name] = np.where(nowhere, np.nan, value)
            out[f"{name} place"] = np.where(nowhere, -1, self.places[name])
        for metric, boxes in self.held.items():
            ordered = np.sort(np.concatenate(boxes, axis=1), axis=1)  # NaN last
            used = counts[f"{metric} used"]
            for part in reduce.quantiles[metric]:
                at = np.clip(np.ceil(used * part).astype(int) - 1, 0, None)
                out[quantile(metric, part)] = np.take_along_axis(ordered, at[:, None], 1)[:, 0]
        return out


def _chosen(grid: Grid, reduce: Reduction, rows: dict[str, np.ndarray]) -> Values:
    """The variables of cells, from statistics [cells, candidates]: those of the best candidate."""
    over = _over(grid)
    out: Values = {}
    if reduce.best:
        at, best, lowest, refused = _best(reduce, rows)
        places = place_values(grid, reduce.best, best)
        out |= {f"best_{name}": values for name, values in places.items()}
        out[f"{reduce.by}_at_best"] = np.where(refused, np.nan, lowest)
        rows = {name: np.take_along_axis(v, at[:, None], 1) for name, v in rows.items()}
        none = best < 0
    else:
        refused = none = np.zeros(len(rows["diverged_share"]), bool)
    flat = {name: values[:, 0] for name, values in rows.items()}
    needs = [*reduce.metrics, *reduce.share]
    for name in needs:
        status = flat[f"{name}_status"]
        if reduce.best:  # what is not known of `by` leaves the choice open, and all that follows
            status = np.where(refused, _why_open(flat, str(reduce.by)), status)
        out[f"{name}_status"] = status
        good = (status == OK) & ~none
        for statistic in _of(reduce, name):
            out[statistic] = np.where(good, flat[statistic], np.nan)
            if f"{statistic} place" in flat:
                place = np.where(good, flat[f"{statistic} place"], -1)
                index = np.unravel_index(np.maximum(place, 0), tuple(over.values()))
                for dim, along in zip(over, index, strict=True):
                    there = place_values(grid, dim, np.where(place < 0, -1, along))
                    out |= {f"{statistic}_{key}": values for key, values in there.items()}
        out[f"{name}_untrusted_share"] = flat[f"{name}_untrusted_share"]
    for name in ("diverged_share", "not_run_share"):
        out[name] = flat[name]
    out["status"] = np.full(len(refused), OK)
    return out


def _why_open(flat: Mapping[str, np.ndarray], by: str) -> np.ndarray:
    """The status of cells whose choice is open, because something of `by` is not known."""
    status = flat[f"{by}_status"]
    return np.where(
        status == OK, NOT_RUN, status
    )  # a scenario was not run, which `untrusted` allows


def _of(reduce: Reduction, name: str) -> list[str]:
    """The statistics of a metric or a condition."""
    if name in reduce.share:
        return [f"{name}_share"]
    kinds = [key for key in ("max", "min", "mean", "std") if name in getattr(reduce, key)]
    parts = [quantile(name, part) for part in reduce.quantiles.get(name, ())]
    return [*(f"{name}_{key}" for key in kinds), *parts]


def _best(
    reduce: Reduction, rows: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each cell: the candidate, the best one or -1, its worst case, and whether it is refused.

    The worst case of a candidate is the largest value of `by`, trusted or not, infinite where a
    scenario diverged. It is a lower bound if a scenario was not run, or if more than `untrusted`
    are not trusted. If even that is larger than another worst case, the choice does not depend on
    it; if it is the smallest, the cell is refused. Where all worst cases are infinite none is best.
    """
    worst = np.where(rows["diverged_share"] > 0, np.inf, rows[f"{reduce.by}_max"])
    worst = np.where(np.isnan(worst), -np.inf, worst)  # nothing of it was run
    lowest = worst.min(axis=1)
    smallest = worst == lowest[:, None]
    doubted = rows[f"{reduce.by}_untrusted_share"] > reduce.untrusted
    unknown = doubted | (rows["not_run_share"] > 0)
    sure = smallest & ~unknown
    at = np.argmax(np.where(sure.any(axis=1)[:, None], sure, smallest), axis=1)
    refused = ~sure.any(axis=1)
    best = np.where(refused | np.isposinf(lowest), -1, at)
    return at, best, lowest, refused
