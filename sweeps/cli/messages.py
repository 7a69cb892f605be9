"""What the commands print, as lines of text."""

import json
import math
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from fic_jax import CHOICES, QUANTITIES
from sweeps.plan.grid import Grid
from sweeps.runner import Progress
from sweeps.spec.digits import digits
from sweeps.spec.mistakes import SweepError, command, printable
from sweeps.spec.types import MAX_RUNS, Sweep
from sweeps.store.format import BUDGET_LEVEL, DEFINITIONS, DIVERGED, REFUSED, size
from sweeps.store.ledger import Row, intact
from sweeps.store.opening import Counts, Store
from sweeps.store.verify import Report

MAX_PROBLEMS = 20  # damaged files that `verify` names
NO_BREAK = "\xa0"  # a space at which no line ends
WIDTH, HEAD = 98, 10  # columns of a line, and of the word that it begins with
MAX_FOREIGN = 5  # files of others that it names
MAX_NAMED = 5  # failed blocks, or diverged scenarios, that `status` names


def plan_lines(grid: Grid, dtype: str) -> list[str]:
    """The size of a sweep: scenarios, blocks, bytes."""
    shape = " x ".join(str(n) for n in grid.block_shape)
    estimates = ", error estimates included" if grid.sweep.error_estimate else ""
    cells = "cell" if grid.sweep.refine else "scenario"
    return [
        f"{_dims(grid.full)} = {counted(grid.full.cells, cells)} of {grid.sweep.n_steps:,} steps",
        *_reduced(grid),
        *_refined(grid),
        f"{counted(grid.n_blocks, 'block')} of up to {shape}",
        *_shard(grid),
        f"{_bytes(size(grid, dtype))} on disk before compression, {dtype}{estimates}",
    ]


def _reduced(grid: Grid) -> Iterator[str]:
    """What is left of the dimensions."""
    if reduce := grid.sweep.reduce:
        best = f", best {reduce.best} by {reduce.by}" if reduce.best else ""
        over = f"reduced over {', '.join(reduce.over)}{best}"
        yield f"{over}: {_dims(grid)} = {counted(grid.cells, 'cell')}"


def _refined(grid: Grid) -> Iterator[str]:
    """What a refined sweep begins with, and how many scenarios it may simulate."""
    if refine := grid.sweep.refine:
        coarse = Grid(grid.sweep.model_copy(update={"refine": None}))
        begin = f"{_dims(coarse)} = {counted(coarse.cells, 'scenario')}"
        halved = f"{', '.join(grid.sweep.refined)} halved up to {counted(refine.levels, 'time')}"
        yield f"refined from {begin}: {halved}"
        why = "the budget" if refine.budget else "all cells; `refine.budget` allows fewer"
        yield f"at most {counted(grid.most_runs, 'scenario')} ({why})"


def reduced_lines(store: Store) -> list[str]:
    """Of each metric or condition of a reduced store, the share of cells that have a value."""
    texts, reduce = [], store.grid.sweep.reduce
    if not reduce:
        return []
    for name in (*reduce.metrics, *reduce.share):
        found = np.bincount(
            np.asarray(store.array(f"{name}_status")[...]).ravel(), minlength=len(REFUSED)
        )
        cells = {word: int(found[code]) for word, code in REFUSED.items() if found[code]}
        whole = store.grid.cells
        ok = _percent(cells.pop("ok", 0), whole)
        why = [f"{_percent(n, whole)} {word}" for word, n in cells.items()]
        texts.append(f"{name} {ok}" + (f" ({'; '.join(why)})" if why else ""))
    value = "a trusted value" if store.grid.sweep.error_estimate else "a value"
    needed = f"each of its scenarios has {value}"
    if reduce.untrusted:
        needed = f"at most {_percent(reduce.untrusted, 1)} of its scenarios lack {value}"
    where = f"a cell has a value where {needed} (`untrusted = {reduce.untrusted:g}`)"
    return [*_in_lines("values", texts), f"{'':{HEAD}}{where}"]


def held_lines(sweep: Sweep) -> list[str]:
    """What does not vary: values that the sweep names, defaults, choices."""
    defaults, held = sweep.defaults(), sweep.held()
    numbers = {name: _quantity(name, value) for name, value in held.items() if name in QUANTITIES}
    choices = {name: f"{name} {value}" for name, value in held.items() if name in CHOICES}
    time = [f"{name} = {value:.12g} s" for name, value in sweep.time]
    parts = {
        "held": time + [text for name, text in numbers.items() if name not in defaults],
        "default": [text for name, text in numbers.items() if name in defaults],
        "model": [t + " (default)" * (name in defaults) for name, t in choices.items()],
    }
    return [line for head, texts in parts.items() for line in _in_lines(head, texts)]


def _quantity(name: str, value: float | str) -> str:
    """A field, its value and its unit: `K0 = 100 N*m/rad`."""
    return f"{name} = {value:.12g} {QUANTITIES[name]['unit']}".removesuffix(" 1")


def _in_lines(head: str, texts: Sequence[str]) -> list[str]:
    """Texts with commas between them, broken at commas; the first line begins with `head`."""
    whole = [text.replace(" ", NO_BREAK) for text in texts]
    rows = textwrap.wrap(", ".join(whole), WIDTH - HEAD, break_on_hyphens=False)
    lines = [row.replace(NO_BREAK, " ") for row in rows]
    return [f"{'' if i else head:{HEAD}}{line}" for i, line in enumerate(lines)]


def expectation(grid: Grid, compiling: float, rate: float) -> str:
    """How long a sweep will take, from seconds to compile a model and scenarios a second."""
    choices = grid.sweep.model.values()
    models = math.prod(len(choice) for choice in choices if isinstance(choice, list))
    seconds = models * compiling + grid.most_runs / rate
    steps = rate * grid.sweep.n_steps / 1e6
    speed = f"{rate:,.0f} scenarios/s ({steps:,.{0 if steps >= 10 else 1}f} M steps/s)"
    most = "at most" if grid.sweep.refine else "about"
    return f"{most} {_duration(seconds)} at {speed} on this machine, measured just now"


def status_lines(store: Store) -> list[str]:
    """How far a store is, and which program made it on which device."""
    counts, attrs, grid = Counts.of(store), store.group.attrs.asdict(), store.grid
    cells = grid.own_cells
    word = "simulated" if grid.sweep.refine else "done"
    diverged = _diverged(store) if counts.cells["diverged"] else ()
    made_by = f"fic_jax {attrs['fic_jax']} ({attrs['revision']}), jax {attrs['jax']}"
    return [
        f"{store.path}: {grid.sweep.name}, {_dims(grid)}",
        *_shard(grid),
        *_reduced(grid),
        *_refined(grid),
        f"{word:{HEAD}}{counts.done:,} of {cells:,} cells ({_percent(counts.done, cells)})",
        *(f"  {name:8}{count:>14,}" for name, count in counts.cells.items()),
        *(f"diverged  {scenario}" for scenario in diverged),
        *(f"failed    {block}" for block in _set_aside(store, counts.set_aside)),
        *_trusted(counts),
        *_budget(store),
        *reduced_lines(store),
        f"metrics   {DEFINITIONS[store.definition]}",
        *held_lines(grid.sweep),
        f"blocks    {len(counts.pending):,} of {len(grid.own):,} to do",
        printable(f"began     {attrs['start']}, ended {attrs.get('end', 'not yet')}"),
        printable(f"made by   {made_by}"),
        printable(f"on        {attrs['device']}, {attrs['dtype']}"),
    ]


def record(store: Store) -> list[tuple[str, str]]:
    """What `status_lines` say, as pairs of a head and a text, without the path of the store."""
    attrs, rows = store.group.attrs.asdict(), [("name", store.grid.sweep.name)]
    for line in [f"{'sweep':{HEAD}}{_dims(store.grid)}", *status_lines(store)[1:]]:
        head, text = line[:HEAD].strip(), line[HEAD:].strip()
        if " " not in line[HEAD - 1 : HEAD + 1]:  # a sentence without a head
            head, _, text = line.partition(" ")
        if head:
            rows.append((head, text))
        else:
            rows[-1] = (rows[-1][0], f"{rows[-1][1]} {text}")
    names = ("numerics", "arithmetic", "jaxlib", "llvmlite", "numpy", "scipy")
    used = [f"{name} {attrs[name]}" for name in names if name in attrs]
    return [*rows, ("with", printable(", ".join(used)))]


def _shard(grid: Grid) -> Iterator[str]:
    """Which shard of a sweep this is, if it is one."""
    if grid.shard:
        scenarios = counted(grid.own_cells * grid.combinations, "scenario")
        size = f"{scenarios} in {counted(len(grid.own), 'block')}"
        yield f"{'shard':{HEAD}}{grid.shard}, {size}"


def _set_aside(store: Store, rows: Sequence[Row]) -> Iterator[str]:
    """Blocks that failed: number, values along each dimension, error."""
    for row in rows[:MAX_NAMED]:
        where = ", ".join(_ends(store.grid, row.block))
        yield f"block {row.block} ({where}) after {row.attempt} attempts: {printable(row.error)}"
    if len(rows) > MAX_NAMED:
        yield f"and {counted(len(rows) - MAX_NAMED, 'more block')}"


def _ends(grid: Grid, index: int) -> Iterator[str]:
    """The first and the last value of a block along each dimension."""
    for dim, part in zip(grid.dims, grid.block(index), strict=True):
        first, last = _value(grid, dim, part.start), _value(grid, dim, part.stop - 1)
        yield f"{dim} {first}" + (f" to {last}" if last != first else "")


def _diverged(store: Store) -> Iterator[str]:
    """The values of the first diverged scenarios. Raises SweepError if a block is damaged."""
    left = MAX_NAMED
    for row in store.rows():
        if not row.diverged or not left:
            continue
        block, checksum = store.grid.block(row.block), row.files.get("status")
        if checksum and not intact(store.file("status", row.block), checksum):
            raise store.damaged(f"block {row.block} is not as it was written")
        places = np.argwhere(np.asarray(store.array("status")[block]) == DIVERGED)[:left]
        for place in places:
            cell = [part.start + int(i) for part, i in zip(block, place, strict=True)]
            values = zip(store.grid.dims, cell, strict=True)
            yield ", ".join(f"{dim} {_value(store.grid, dim, i)}" for dim, i in values)
        left -= len(places)


def _value(grid: Grid, dim: str, index: int) -> str:
    """The value at an index of a dimension; for `scenario` the index itself."""
    if dim == "scenario":
        return str(index)
    value = grid.coordinates(dim, slice(index, index + 1))[dim][0]
    if isinstance(value, str):
        return str(value)
    near = grid.coordinates(dim, slice(max(index - 1, 0), index + 2))[dim]
    return f"{value:.{digits(near)}g}"


def progress_line(progress: Progress) -> str:
    """Rate and time left."""
    if progress.blocks:
        return f"{counted(progress.blocks, 'block')} written"
    if not progress.ran:
        return "compiling" if progress.done < progress.cells else "complete already"
    rate = progress.ran / progress.seconds
    left = (progress.cells - progress.done) / rate
    rate *= progress.combinations
    most = "at most " if progress.refined and left else ""
    return f"{rate:,.0f} scenarios/s, {most}{_duration(left)} left"


def log_line(progress: Progress) -> str:
    """How far a run is, for a log."""
    share = _percent(progress.done, progress.cells)
    most = "at most " if progress.refined else ""
    failed = f"; {counted(len(progress.set_aside), 'block')} failed" if progress.set_aside else ""
    of = f"{progress.done:,} of {most}{progress.cells:,} ({share})"
    return f"{of} {progress_line(progress)}{failed}"


def summary(store: Store, result: Progress) -> str:
    """What a run has done."""
    if not (result.ran or result.blocks or result.set_aside):
        scenarios = counted(result.cells * result.combinations, "scenario")
        return "\n".join([f"{store.path}: complete already, {scenarios}", *_budget(store)])
    counts = Counts.of(store)
    lines = [f"{store.path}: {_done(store, result)}", *_nearby(store, counts), *_trusted(counts)]
    lines += _budget(store)
    lines += reduced_lines(store)
    return "\n".join(lines)


def _done(store: Store, result: Progress) -> str:
    """What a run has simulated, or only written, and in what time."""
    took = f"in {_duration(result.seconds)}"
    if not (result.ran or result.set_aside):
        blocks = counted(result.blocks, "block")
        return f"{counted(result.cells, 'scenario')} simulated before, {blocks} written {took}"
    ran = result.ran * result.combinations
    rate = ran / result.seconds
    steps = rate * store.grid.sweep.n_steps / 1e6
    speed = f", {rate:,.0f}/s ({steps:,.0f} M steps/s)" if steps >= 1 else ""
    diverged = f", {result.diverged:,} diverged" if result.diverged else ""
    return f"{counted(ran, 'scenario')} {took}{speed}{diverged}"


def _nearby(store: Store, counts: Counts) -> Iterator[str]:
    """How many cells of a refined store were simulated, and what the others have."""
    if near := counts.cells.get("nearby"):
        cells = store.grid.cells
        simulated = f"{counts.done:,} of {cells:,} cells simulated, {_percent(counts.done, cells)}"
        yield f"{'refined':{HEAD}}{simulated}"
        yield f"{'':{HEAD}}{near:,} have the values of a simulated cell beside them"


def _budget(store: Store) -> Iterator[str]:
    """Whether its budget ended a refined run, and how to go on."""
    level, refine = store.group.attrs.get(BUDGET_LEVEL), store.grid.sweep.refine
    if level is None or refine is None:
        return
    budget = store.grid.most_runs
    left = f"from level {level} of {refine.levels} on, boxes that differ are not halved"
    yield f"{'budget':{HEAD}}{counted(budget, 'scenario')} ended the run: {left}"
    if budget < MAX_RUNS:
        more = min(2 * budget, store.grid.cells, MAX_RUNS)
        yield f"{'':{HEAD}}{command('resume', store.path, '--budget', more)} goes on"


def merged(store: Store) -> str:
    """What a merge has made."""
    parts = counted(len(json.loads(str(store.group.attrs["parts"]))), "part")
    counts = Counts.of(store)
    rest = f"; {counted(len(counts.pending), 'block')} still to run: {_resume(store)} does"
    scenarios = counted(counts.done * store.grid.combinations, "scenario")
    done = f"{store.path}: {scenarios} of {parts}"
    return done + (rest if counts.pending else "")


def failed_blocks(store: Store, result: Progress) -> Iterator[str]:
    """Which blocks a run could not compute, and how to try again."""
    blocks = f"{counted(len(result.set_aside), 'block')} of {len(store.grid.own):,}"
    yield f"{blocks} failed and set aside; {_resume(store)} tries again"
    yield from _set_aside(store, result.set_aside)


def verification(path: Path, report: Report) -> Iterator[str]:
    """How many files `verify` has read, and each that is not as it was written."""
    files = counted(report.files, "file")
    if report.blocks is not None:
        files = f"{counted(report.blocks, 'block')}, {files}"
    result = f"{len(report.problems):,} not as written" if report.problems else "all as written"
    yield f"{path}: {files}: {result}"
    yield from (f"  {problem.what} {problem.how}" for problem in report.problems[:MAX_PROBLEMS])
    if len(report.problems) > MAX_PROBLEMS:
        yield f"  and {len(report.problems) - MAX_PROBLEMS:,} more"
    if report.blocks is None:
        yield "  the blocks can be verified once this is repaired"
    elif report.blocks < report.planned:
        still = counted(report.planned - report.blocks, "block")
        # what can't be repaired here, a run does again
        repair = any(problem.repairable for problem in report.problems)
        resume = "" if repair else f": {command('resume', path)} does"
        yield f"  {still} still to run{resume}"
    if report.foreign:
        names = ", ".join(printable(name) for name in report.foreign[:MAX_FOREIGN])
        more = ", ..." if len(report.foreign) > MAX_FOREIGN else ""
        yield f"  not part of the store, and harmless: {names}{more}"


def interrupted(store: Store, error: BaseException) -> str:
    """Why a run ended early, how many blocks are done, and how to continue."""
    why = "interrupted" if isinstance(error, KeyboardInterrupt) else f"failed: {_reason(error)}"
    rest = f"{_resume(store)} does the rest"
    try:
        each = store.grid.combinations
        done, all_ = Counts.of(store).done * each, store.grid.most_runs
    except (OSError, SweepError):  # the folder is gone, or has become unreadable
        return f"{why}; what was finished is kept if the folder is, {rest}"
    most = "at most " if store.grid.sweep.refine else ""
    return f"{why}; {done:,} of {most}{counted(all_, 'scenario')} are kept, {rest}"


def _resume(store: Store) -> str:
    """The command that continues a store."""
    return command("resume", store.path)


def system_error(path: Path, error: OSError) -> str:
    """What the system refused while a command changed or read a store."""
    return f"{path}: failed: {_reason(error)}; what was finished is kept"


def _reason(error: BaseException) -> str:
    """The system's words, after the file they are about."""
    words = getattr(error, "strerror", None) or str(error)
    file = getattr(error, "filename", None)
    return f"{file}: {words}" if file else words


def _trusted(counts: Counts) -> list[str]:
    """Of each metric, the share of finished cells in which it is trusted."""
    shares = [f"{name} {_percent(n, counts.done)}" for name, n in counts.trusted.items()]
    return _in_lines("trusted", shares)


def _dims(grid: Grid) -> str:
    return " x ".join(f"{name} {n}" for name, n in grid.dims.items())


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    if minutes < 100:
        return f"{minutes:.1f} min"
    return f"{minutes // 60:.0f} h {minutes % 60:.0f} min"


def _bytes(n: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if n < 1000:
            return f"{n:.3g} {unit}"
        n /= 1000
    return f"{n:.3g} TB"


def counted(n: int, noun: str) -> str:
    """A number with its noun: 1 block, 2 blocks."""
    return f"{n:,} {noun}" + ("" if n == 1 else "s")


def _percent(part: float, whole: int) -> str:
    return f"{100 * part / max(whole, 1):.4g} %"
