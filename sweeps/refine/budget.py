"""A larger budget for a refined store: what it has simulated becomes the journal of a new one."""

from collections.abc import Iterator

import numpy as np

from sweeps.plan.grid import Grid
from sweeps.refine.table import NONE, Table
from sweeps.spec.mistakes import SweepError
from sweeps.spec.types import Sweep
from sweeps.store.commit import Writer
from sweeps.store.extend import replaced
from sweeps.store.format import BUDGET_LEVEL
from sweeps.store.opening import Counts, Store

PIECE = 1_000_000  # scenarios in a file of the journal: 50 to 100 MB


def with_budget(store: Store, plan: Sweep, source: str) -> Store:
    """The store as the beginning of the same sweep with a larger budget; a run does the rest.

    A run with the larger budget simulates all that this one has: it takes more of the same boxes in
    the same order. Raises SweepError, with a line for each reason, if `plan` (from `source`)
    differs in anything else, or if the budget did not end the run.
    """
    grid = Grid(plan, store.grid.chunk)
    if problems := list(_differences(store, grid)):
        raise SweepError("\n".join(f"{source}: {problem}" for problem in problems))

    def fill(writer: Writer) -> None:
        table = Table(store.grid)
        table.read(store)
        cells = np.flatnonzero(table.row != NONE)
        for start in range(0, len(cells), PIECE):
            part = cells[start : start + PIECE]
            values = {name: table.values(name, part) for name in table.columns}
            writer.store.journal.append(part, values)

    return replaced(store, grid, fill)


def _differences(store: Store, grid: Grid) -> Iterator[str]:
    """What keeps a sweep from being that of the store with a larger budget."""
    old, new = store.grid.sweep, grid.sweep
    assert old.refine
    other = sorted(
        key
        for key in Sweep.model_fields
        if key not in _FREE and getattr(old, key) != getattr(new, key)
    )
    if new.refine:
        budget = {"budget": old.refine.budget}
        other += ["refine"] if new.refine.model_copy(update=budget) != old.refine else []
    else:
        other.append("refine")
    for key in other:
        yield f"`{key}` must be as in the store: a refined sweep takes a larger budget alone."
    if new.precision and f"float{new.precision}" != store.dtype:
        yield f"`precision` must be that of the store, {store.dtype.removeprefix('float')}."
    if other:
        return
    before, most = store.grid.most_runs, store.grid.cells
    if before == most:
        yield f"the store may simulate all its {most:,} cells: a larger budget changes nothing."
    elif grid.most_runs <= before:
        yield f"the budget must be more than the store's {before:,}, but is {grid.most_runs:,}."
    elif not Counts.of(store).pending and BUDGET_LEVEL not in store.group.attrs:
        yield "nothing is left to halve: a larger budget would change nothing."


_FREE = ("name", "description", "precision", "refine")  # compared by themselves, or not at all
