"""What the command line says, as lines of text. Prints nothing."""

import math
from collections.abc import Iterator

from sweeps.grid import Grid
from sweeps.layout import size
from sweeps.runner import Progress
from sweeps.store import Store


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
    counts, attrs, grid = store.counts(), store.group.attrs.asdict(), store.grid
    done = grid.cells - counts["not run"]
    return [
        f"{store.path}: {grid.sweep.name}, {_dims(grid)}",
        f"done      {done:,} of {grid.cells:,} cells ({_share(done, grid.cells)})",
        *(f"  {name:8}{count:>14,}" for name, count in counts.items()),
        *(f"trusted   {told}" for told in _trusted(store, done)),
        f"blocks    {len(store.pending()):,} of {grid.n_blocks:,} to do",
        f"began     {attrs['start']}, ended {attrs.get('end', 'not yet')}",
        f"made by   fic_jax {attrs['fic_jax']} ({attrs['revision']}), jax {attrs['jax']}",
        f"on        {attrs['device']}, {attrs['dtype']}",
    ]


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
    return f"{progress.done:,} of {progress.cells:,} ({share}) {progress_line(progress)}"


def summary(store: Store, result: Progress) -> str:
    """What a run did."""
    if not result.ran:
        return f"{store.path}: complete already, {result.cells:,} scenarios"
    rate = result.ran / result.seconds
    steps = rate * store.grid.sweep.n_steps / 1e6
    speed = f", {rate:,.0f}/s ({steps:,.0f} M steps/s)" if steps >= 1 else ""
    diverged = f", {result.diverged:,} diverged" if result.diverged else ""
    told = [f"{result.ran:,} scenarios in {_duration(result.seconds)}{speed}{diverged}"]
    told += [f"trusted {text}" for text in _trusted(store, result.done)]
    return f"{store.path}: {'; '.join(told)}"


def interruption(store: Store, error: BaseException) -> str:
    """Why a run ended early, what is kept and how to go on."""
    why = "interrupted" if isinstance(error, KeyboardInterrupt) else f"failed: {error}"
    total = store.grid.n_blocks
    kept = total - len(store.pending())
    go_on = f"`fic-sweep resume {store.path}` does the rest"
    return f"{why}; {kept} of {total} blocks are kept, {go_on}"


def _trusted(store: Store, done: int) -> Iterator[str]:
    """How many of the cells done are trusted, where the store can tell."""
    counted = store.trusted()
    if counted is not None:
        number, bound = counted
        share = f"{number:,} of {done:,} cells ({_share(number, done)})"
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


def _share(part: int, whole: int) -> str:
    return f"{100 * part / max(whole, 1):.4g} %"
