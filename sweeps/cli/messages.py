"""What the command line says, as lines of text. Prints nothing."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sweeps.plan.grid import Grid
from sweeps.runner import Progress
from sweeps.spec.types import SweepError, shown
from sweeps.store.format import DIVERGED, size
from sweeps.store.ledger import Row, intact
from sweeps.store.opening import Counts, Store
from sweeps.store.verify import Report

LISTED = 20  # damaged files
NAMED = 5  # blocks or scenarios named before it becomes "and so many more"


def plan_lines(grid: Grid, dtype: str) -> list[str]:
    """What a sweep comes to: scenarios, blocks, bytes."""
    shape = " x ".join(str(n) for n in grid.block_shape)
    estimates = ", error estimates included" if grid.sweep.error_estimate else ""
    return [
        f"{_dims(grid)} = {grid.cells:,} scenarios of {grid.sweep.n_steps:,} steps",
        f"{grid.n_blocks:,} blocks of up to {shape}",
        f"{_size(size(grid, dtype))} on disk before compression{estimates}",
    ]


def expectation(grid: Grid, compiling: float, rate: float) -> str:
    """How long a sweep will take, from seconds to compile and scenarios a second."""
    choices = grid.sweep.model.values()
    programs = math.prod(len(choice) for choice in choices if isinstance(choice, list))
    seconds = programs * compiling + grid.cells / rate
    speed = f"{rate:,.0f} scenarios/s ({rate * grid.sweep.n_steps / 1e6:,.0f} M steps/s)"
    return f"about {_duration(seconds)} at {speed} on this machine, measured just now"


def status_lines(store: Store) -> list[str]:
    """How far a store is and what made it."""
    counts, attrs, grid = Counts.of(store), store.group.attrs.asdict(), store.grid
    done = counts.done
    return [
        f"{store.path}: {grid.sweep.name}, {_dims(grid)}",
        f"done      {done:,} of {grid.cells:,} cells ({_share(done, grid.cells)})",
        *(f"  {name:8}{count:>14,}" for name, count in counts.cells.items()),
        *(f"diverged  {told}" for told in _diverged(store)),
        *(f"failed    {told}" for told in set_aside_lines(store, counts.set_aside)),
        *(f"trusted   {told}" for told in _trusted(store, counts)),
        f"blocks    {len(counts.pending):,} of {grid.n_blocks:,} to do",
        shown(f"began     {attrs['start']}, ended {attrs.get('end', 'not yet')}"),
        shown(f"made by   fic_jax {attrs['fic_jax']} ({attrs['revision']}), jax {attrs['jax']}"),
        shown(f"on        {attrs['device']}, {attrs['dtype']}"),
    ]


def set_aside_lines(store: Store, rows: Sequence[Row]) -> Iterator[str]:
    """Which blocks could not be computed, where they are, and why."""
    for row in rows[:NAMED]:
        where = ", ".join(_stretch(store.grid, row.block))
        yield f"block {row.block} ({where}) after {row.attempt} attempts: {shown(row.error)}"
    if len(rows) > NAMED:
        yield f"and {many(len(rows) - NAMED, 'more block')}"


def _stretch(grid: Grid, index: int) -> Iterator[str]:
    """What a block covers along each dimension."""
    for dim, part in zip(grid.dims, grid.block(index), strict=True):
        first, last = _value(grid, dim, part.start), _value(grid, dim, part.stop - 1)
        yield f"{dim} {first}" + (f" to {last}" if last != first else "")


def _diverged(store: Store) -> Iterator[str]:
    """The first diverged scenarios by name."""
    left = NAMED
    for row in store.rows():
        if not row.diverged or not left:
            continue
        block, checksum = store.grid.block(row.block), row.files.get("status")
        if checksum and not intact(store.file("status", row.block), checksum):
            raise store.damaged(f"block {row.block} is not as it was written")
        found = np.argwhere(np.asarray(store.array("status")[block]) == DIVERGED)[:left]
        for place in found:
            cell = [part.start + int(i) for part, i in zip(block, place, strict=True)]
            at = zip(store.grid.dims, cell, strict=True)
            yield ", ".join(f"{dim} {_value(store.grid, dim, i)}" for dim, i in at)
        left -= len(found)


def _value(grid: Grid, dim: str, index: int) -> str:
    """The value at one place of a dimension; a scenario has its number only."""
    if dim == "scenario":
        return str(index)
    value = grid.coordinates(dim, slice(index, index + 1))[dim][0]
    return str(value) if isinstance(value, str) else f"{value:g}"


def progress_line(progress: Progress) -> str:
    """Rate and time left."""
    if not progress.ran:
        return "compiling" if progress.done < progress.cells else "complete already"
    rate = progress.ran / progress.seconds
    left = (progress.cells - progress.done) / rate
    return f"{rate:,.0f} scenarios/s, {_duration(left)} left"


def log_line(progress: Progress) -> str:
    """How far a run is, for a log."""
    share = _share(progress.done, progress.cells)
    failed = f"; {many(len(progress.set_aside), 'block')} failed" if progress.set_aside else ""
    return f"{progress.done:,} of {progress.cells:,} ({share}) {progress_line(progress)}{failed}"


def summary(store: Store, result: Progress) -> str:
    """What a run did."""
    if not result.ran and not result.set_aside:
        return f"{store.path}: complete already, {result.cells:,} scenarios"
    rate = result.ran / result.seconds
    steps = rate * store.grid.sweep.n_steps / 1e6
    speed = f", {rate:,.0f}/s ({steps:,.0f} M steps/s)" if steps >= 1 else ""
    diverged = f", {result.diverged:,} diverged" if result.diverged else ""
    told = [f"{result.ran:,} scenarios in {_duration(result.seconds)}{speed}{diverged}"]
    told += [f"trusted {text}" for text in _trusted(store, Counts.of(store))]
    return f"{store.path}: {'; '.join(told)}"


def failure(store: Store, result: Progress) -> Iterator[str]:
    """What a run could not compute, and how to try again."""
    blocks = f"{many(len(result.set_aside), 'block')} of {store.grid.n_blocks:,}"
    yield f"{blocks} failed and set aside; `fic-sweep resume {store.path}` tries again"
    yield from set_aside_lines(store, result.set_aside)


def verification(path: Path, report: Report) -> Iterator[str]:
    """What was looked at, and each thing that is not as it was written."""
    looked = f"{path}: {many(report.files, 'file')}"
    if report.blocks is not None:
        looked = f"{path}: {many(report.blocks, 'block')}, {many(report.files, 'file')}"
    if report.problems:
        yield f"{looked}: {len(report.problems):,} not as written"
    else:
        yield f"{looked}: all as written"
    yield from (f"  {problem.what} {problem.how}" for problem in report.problems[:LISTED])
    if len(report.problems) > LISTED:
        yield f"  and {len(report.problems) - LISTED:,} more"
    if report.blocks is None:
        yield "  its blocks can be looked at once that is mended"
    elif report.blocks < report.planned:
        yield f"  {many(report.planned - report.blocks, 'block')} still to run"


def interruption(store: Store, error: BaseException) -> str:
    """Why a run ended early, what is kept and how to go on."""
    why = "interrupted" if isinstance(error, KeyboardInterrupt) else f"failed: {_reason(error)}"
    total, go_on = store.grid.n_blocks, f"`fic-sweep resume {store.path}` does the rest"
    try:
        kept = total - len(Counts.of(store).pending)
    except (OSError, SweepError):  # the folder is gone, or not ours any more
        return f"{why}; what was finished is kept if the folder is, {go_on}"
    return f"{why}; {kept} of {total} blocks are kept, {go_on}"


def refusal(path: Path, error: OSError) -> str:
    """What the system refused while a store was changed, or looked at."""
    return f"{path}: failed: {_reason(error)}; what was finished is kept"


def _reason(error: BaseException) -> str:
    """What the system said, and about which file."""
    told = getattr(error, "strerror", None) or str(error)
    about = getattr(error, "filename", None)
    return f"{about}: {told}" if about else told


def _trusted(store: Store, counts: Counts) -> Iterator[str]:
    """How many of the cells done are trusted, where the store can tell."""
    if store.grid.sweep.error_estimate:
        share = (
            f"{counts.trusted:,} of {counts.done:,} cells ({_share(counts.trusted, counts.done)})"
        )
        bound = float(str(store.group.attrs["trust_bound"]))
        yield f"{share}, nmse known to {100 * bound:g} %"


def _dims(grid: Grid) -> str:
    return " x ".join(f"{name} {n}" for name, n in grid.dims.items())


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    if minutes < 100:
        return f"{minutes:.1f} min"
    return f"{minutes // 60:.0f} h {minutes % 60:.0f} min"


def _size(n: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if n < 1000:
            return f"{n:.3g} {unit}"
        n /= 1000
    return f"{n:.3g} TB"


def many(n: int, word: str) -> str:
    """A number of things, the word in its right form."""
    return f"{n:,} {word}" + ("" if n == 1 else "s")


def _share(part: int, whole: int) -> str:
    return f"{100 * part / max(whole, 1):.4g} %"
