"""From a sweep to a store: plan, blocks, engine, commit. Prints nothing; tells a callback."""

import time
from collections import deque
from collections.abc import Callable, Collection, Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from fic_jax import Metrics, Params, sweep, tune_for_throughput
from sweeps import compile_cache
from sweeps.plan.grid import Block, Grid, cells_of
from sweeps.provenance import IDENTITY, provenance
from sweeps.spec.mistakes import SweepError
from sweeps.spec.rules import out_of_bounds
from sweeps.spec.types import Sweep
from sweeps.store.commit import Values, Writer, changing, kept, no_values, now, values_of
from sweeps.store.format import create
from sweeps.store.ledger import DONE, SET_ASIDE, Row
from sweeps.store.lock import Owner
from sweeps.store.opening import DIVERGED, FAILED, OK, Store, Tally, open_store

ATTEMPTS = 3  # at a block before it is set aside

MEASURED_STEPS = 30_000_000  # plant steps of a dry run's measurement, some tenths of a second
MEASURED_LEAST = 512  # scenarios, so that no device has idle lanes


@dataclass(frozen=True)
class Progress:
    """Told once before the first block and once after each that is on disk."""

    cells: int  # of the whole sweep
    done: int  # cells of finished blocks
    ran: int = 0  # cells done by this run
    diverged: int = 0  # among them
    seconds: float = 0.0  # since this run began
    set_aside: tuple[Row, ...] = ()  # blocks that this run could not compute

    def after(self, row: Row, cells: int, known: Row | None, seconds: float) -> "Progress":
        """Once a block of `cells` is on disk, of which some were `known` before."""
        if row.outcome == SET_ASIDE:
            return replace(self, seconds=seconds, set_aside=(*self.set_aside, row))
        diverged = row.diverged - (known.diverged if known else 0)
        ran = row.ok - (known.ok if known else 0) + diverged
        return replace(
            self,
            done=self.done + cells,
            ran=self.ran + ran,
            diverged=self.diverged + diverged,
            seconds=seconds,
        )


Tell = Callable[[Progress], None]


def configure(precision: int, device: str | None = None) -> None:
    """Set JAX up for sweeps, with programs kept from run to run; before JAX starts.

    `device` is "cpu", "gpu" or what JAX prefers. Raises SweepError where there is no such device.
    """
    tune_for_throughput()
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    elif device:
        try:
            jax.devices(device)
        except RuntimeError:
            needed = "a GPU needs a driver and `pip install 'jax[cuda12]'`"
            raise SweepError(f"JAX {jax.__version__} finds no {device} here; {needed}") from None
    jax.config.update("jax_enable_x64", precision == 64)
    cache = compile_cache.folder()
    own = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if cache is not None and not own:
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def start(path: Path, plan: Sweep, chunk: int | None, precision: int) -> Store:
    """Make the store of a new run. Raises SweepError if it can't be."""
    for problem in out_of_bounds(plan, f"float{precision}"):
        raise SweepError(f"{plan.name} in {precision} bits: {problem}")
    attributes = provenance(precision) | {"start": now()}
    return create(path, Grid(plan, chunk), attributes)


def reopen(path: Path, precision: int) -> Store:
    """Open a store to be continued; refuses one that another program began."""
    store = open_store(path)
    began, now = store.group.attrs.asdict(), provenance(precision)
    differing = [f"{k} was {began.get(k)}, is {now[k]}" for k in IDENTITY if began.get(k) != now[k]]
    if differing:
        raise SweepError(
            f"{path}: was begun by another program ({'; '.join(differing)}); "
            "continue it with that one, or remove it and run the sweep again"
        )
    return store


def run(store: Store, tell: Tell, only: Collection[int] | None = None) -> Progress:
    """Run every block (or those named) that is not done; safe to interrupt between any two lines.

    Raises SweepError where another process is at it, OSError where the disk refuses.
    """
    grid, began = store.grid, time.perf_counter()
    with changing(store) as (writer, owner):
        tally = Tally.of(store)
        pending = [i for i in tally.pending if only is None or i in only]
        todo = sum(cells_of(grid.block(index)) for index in tally.pending)
        progress = Progress(grid.cells, grid.cells - todo)
        tell(progress)
        # what its process was killed in may be what killed it, and comes last
        pending.sort(key=lambda index: index == owner.died_at)
        with closing(_committed(writer, owner, pending, tally.begun)) as committed:
            for row, when in committed:
                n, known = cells_of(grid.block(row.block)), tally.begun.get(row.block)
                progress = progress.after(row, n, known, when - began)
                tell(progress)
        if progress.done == grid.cells and "end" not in store.group.attrs:
            writer.ended()  # also where an interruption came just before this line
    return progress


def _committed(
    writer: Writer, owner: Owner, pending: list[int], begun: Mapping[int, Row]
) -> Generator[tuple[Row, float]]:
    """Compute the blocks and commit them: each, and when it was on disk.

    A block is written while the next one is computed, and told of after that. Whoever stops
    asking loses none that is computed: closing waits until it is written. A block that fails
    comes again after all others, and is set aside in the end.
    """
    queue = deque((index, 1) for index in pending)

    def commit(values: Values, row: Row) -> tuple[Row, float]:
        return writer.commit(values, row), time.perf_counter()

    with ThreadPoolExecutor(1) as pool:
        last: Future[tuple[Row, float]] | None = None
        while queue:
            index, attempt = queue.popleft()
            owner.takes(index)
            values, row = _attempt(writer.store, index, begun.get(index), attempt)
            if row.outcome == SET_ASIDE and attempt < ATTEMPTS:
                queue.append((index, attempt + 1))
                continue
            before, last = last, pool.submit(commit, values, row)
            if before:
                yield before.result()
        if last:
            yield last.result()


def _attempt(store: Store, index: int, known: Row | None, attempt: int) -> tuple[Values, Row]:
    """Compute a block; what is known of it, from a smaller store, is not computed again."""
    block, began = store.grid.block(index), time.perf_counter()
    before = kept(store, known) if known else None
    todo: slice | np.ndarray = slice(None)
    if before:
        todo = np.isin(before["status"], (OK, DIVERGED), invert=True)
    try:
        values = values_of(*_compute(store.grid, block, store.dtype, todo))
    except Exception as error:  # the sweep goes on without it, and says so
        told = f"{type(error).__name__}: {error}".splitlines()[0][:300]
        values = before or no_values(store.grid, index)
        values["status"][todo] = FAILED
        return values, Row(index, SET_ASIDE, attempt=attempt, error=told)
    if before:
        for name in before:
            before[name][todo] = values[name]
        values = before
    return values, Row(index, DONE, seconds=time.perf_counter() - began, attempt=attempt)


def _compute(
    grid: Grid, block: Block, dtype: str, cells: slice | np.ndarray = slice(None)
) -> tuple[Metrics, Metrics | None]:
    """Metrics of a block, or of some of its scenarios, and their errors where wanted.

    In the precision of the store.
    """
    params = {name: np.asarray(v, dtype) for name, v in vars(grid.params(block, dtype)).items()}
    batch = Params(**{name: v[cells] if v.ndim else v for name, v in params.items()})
    plan = grid.sweep
    model, dt, n_steps = grid.model(block), plan.time.dt, plan.n_steps
    if plan.error_estimate:
        return sweep(batch, model=model, dt=dt, n_steps=n_steps, error_estimate=True)
    return sweep(batch, model=model, dt=dt, n_steps=n_steps), None


def measure(grid: Grid, dtype: str) -> tuple[float, float]:
    """Seconds before the first result, and scenarios a second, from a short run of the plan."""
    block = next(grid.blocks())
    n = min(cells_of(block), max(MEASURED_STEPS // grid.work, MEASURED_LEAST))
    seconds = []
    for _ in range(2):
        began = time.perf_counter()
        _compute(grid, block, dtype, slice(n))
        seconds.append(time.perf_counter() - began)
    return max(seconds[0] - seconds[1], 0.0), n / seconds[1]
