"""Run a sweep into a store: plan, blocks, engine, commit. Prints nothing; reports to a callback."""

import time
from collections import deque
from collections.abc import Callable, Collection, Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from fic_jax import Metrics, Model, Params, sweep, tune_for_throughput
from sweeps import compile_cache, devices
from sweeps.plan.grid import Block, Grid, cells_of
from sweeps.plan.shard import Shard
from sweeps.provenance import differences, provenance
from sweeps.reduce.fold import block_values
from sweeps.refine.rounds import rounds
from sweeps.spec.mistakes import SweepError
from sweeps.spec.rules import out_of_bounds
from sweeps.spec.types import Sweep
from sweeps.store.commit import Values, Writer, no_values, now, read_block, values_of, writing
from sweeps.store.create import check_new, create
from sweeps.store.format import BUDGET_LEVEL, DIVERGED, FAILED, OF_RUN, OK, attributes
from sweeps.store.ledger import DONE, SET_ASIDE, Row
from sweeps.store.lock import Lock
from sweeps.store.opening import Counts, Store, open_store
from sweeps.store.verify import free

ATTEMPTS = 3  # at a block before it is set aside

MEASURED_STEPS = 30_000_000  # plant steps of a dry run's measurement, some tenths of a second
MEASURED_LEAST = 512  # scenarios, so that no device has idle lanes


@dataclass(frozen=True)
class Progress:
    """The state of a run, before its first block and after each that is on the disk."""

    cells: int  # of the whole sweep, or of the shard
    done: int  # cells of finished blocks
    ran: int = 0  # cells done by this run
    diverged: int = 0  # among them
    seconds: float = 0.0  # since this run began
    set_aside: tuple[Row, ...] = ()  # blocks that this run could not compute
    combinations: int = 1  # scenarios of a cell
    refined: bool = False  # `cells` is the most that there may be, until the end
    blocks: int = 0  # of a refined sweep, written by this run after all simulations

    def __str__(self) -> str:
        """How far the run is, in one line: `on_progress=print` shows it."""
        scenarios = self.ran * self.combinations
        rate = f", {scenarios / self.seconds:,.0f} scenarios/s" if scenarios else ""
        share = self.done / max(self.cells, 1)
        return f"{self.done:,} of {self.cells:,} cells ({100 * share:.0f} %){rate}"

    def after(self, row: Row, cells: int, known: Row | None, seconds: float) -> "Progress":
        """The state after a block of `cells`; its row before this run is `known`."""
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


OnProgress = Callable[[Progress], None]
# Rows that have just been committed, perhaps none, and the time at which they were on the disk.
Committed = tuple[list[Row], float]
# Computes and commits blocks of a store: its writer, its lock, the blocks, what is known of some.
RunBlocks = Callable[[Writer, Lock, list[int], Mapping[int, Row]], Generator[Committed]]


def prepare(device: str | None = None, cores: int | None = None) -> None:
    """Set JAX up for sweeps, with a compile cache, and start it.

    `device` is "cpu", "gpu" or None for JAX's choice; a CPU's sweeps use `cores`, or all. Raises
    SweepError if it does not exist or a variable of the environment keeps JAX from starting,
    RuntimeError if JAX has started.
    """
    devices.check_xla_flags()
    tune_for_throughput(cores)
    cache, users = compile_cache.folder(), jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if cache is not None and not users:
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    devices.start(device)


def configure(precision: int, device: str | None = None) -> None:
    """`prepare` JAX, and set its precision for all that a command does. Raises as `prepare`."""
    jax.config.update("jax_enable_x64", precision == 64)
    prepare(device)


def check_start(
    path: Path, plan: Sweep, chunk: int | None, precision: int, shard: Shard | None = None
) -> None:
    """Raise SweepError if `start` would: for values, for a path in use, for a small disk."""
    for problem in out_of_bounds(plan, f"float{precision}"):
        raise SweepError(f"{plan.name} in {precision} bits: {problem}")
    check_new(path, Grid(plan, chunk, shard), f"float{precision}")


def start(
    path: Path, plan: Sweep, chunk: int | None, precision: int, shard: Shard | None = None
) -> Store:
    """Make the store of a new run, of a whole sweep or a shard. Raises SweepError if it can't."""
    check_start(path, plan, chunk, precision, shard)
    return create(path, Grid(plan, chunk, shard), provenance(precision) | {"start": now()})


def start_or_reopen(
    path: Path, plan: Sweep, chunk: int | None, precision: int, shard: Shard | None
) -> Store:
    """`start` a run or, if its store exists, `reopen` it: a job array repeats its command.

    Raises SweepError as they do, and if `path` has another shard or another sweep.
    """
    if not (path / "zarr.json").is_file():
        return start(path, plan, chunk, precision, shard)
    found, wanted = open_store(path), attributes(Grid(plan, chunk, shard))
    other = [word for key, word in OF_RUN.items() if found.group.attrs.get(key) != wanted[key]]
    other += ["--shard"] if found.grid.shard != shard else []
    other += ["--precision"] if found.dtype != f"float{precision}" else []
    other = ["sweep"] if "sweep" in other else other  # all else follows from it
    if other:
        raise SweepError(f"{path}: was begun with another {', '.join(other)}; --out names another")
    store = reopen(path, precision)
    store.check_done()
    return store


def reopen(path: Path, precision: int) -> Store:
    """Open a store to continue it. Raises SweepError if this process would give other bits."""
    store = open_store(path)
    store.check_definition()
    began = store.group.attrs.asdict()
    differing = differences(began, provenance(precision))
    if "numerics" not in began:  # its `program` was a hash of source text: it compares with nothing
        differing = ["it does not record its numerics and arithmetic, so its bits can't be matched"]
    if differing:
        raise SweepError(
            f"{path}: was begun by another program ({'; '.join(differing)}); "
            f"continue it with that one; {store.run_again()} runs its sweep again"
        )
    return store


def run(
    store: Store,
    on_progress: OnProgress,
    only: Collection[int] | None = None,
    run_blocks: RunBlocks | None = None,
) -> Progress:
    """Run every block (or those in `only`) that is not done; safe to interrupt at any line.

    `run_blocks` computes and commits them, in this process if it is None. Raises SweepError if
    another process changes the store, OSError if the disk refuses.
    """
    if store.grid.sweep.refine:
        return _run_rounds(store, on_progress)
    grid, began = store.grid, time.perf_counter()
    with writing(store) as (writer, lock):
        counts = Counts.of(store)
        pending = [i for i in counts.pending if only is None or i in only]
        todo = sum(cells_of(grid.block(index)) for index in counts.pending)
        done = grid.own_cells - todo
        progress = Progress(grid.own_cells, done, combinations=grid.combinations)
        on_progress(progress)
        # The block in which the last process was killed may be what killed it: it comes last.
        pending.sort(key=lambda index: index == lock.killed_in)
        blocks = (run_blocks or _run_blocks)(writer, lock, pending, counts.unfinished)
        with closing(blocks) as committed:
            for rows, when in committed:
                for row in rows:
                    n, known = cells_of(grid.block(row.block)), counts.unfinished.get(row.block)
                    progress = progress.after(row, n, known, when - began)
                on_progress(progress)
        if progress.done == progress.cells and "end" not in store.group.attrs:
            writer.end()
    return progress


def _run_rounds(store: Store, on_progress: OnProgress) -> Progress:
    """Run what is left of a refined sweep."""
    grid, began = store.grid, time.perf_counter()

    def simulate(cells: np.ndarray) -> Values:
        batch, model = grid.scenarios(cells, store.dtype)
        with _precision(store.dtype):
            values = values_of(*_simulated(grid.sweep, batch, model), grid.sweep.time.t_end)
        # as a resumed run reads them
        return {
            name: np.asarray(values[name], store.array(name).dtype)
            for name in store.variables
            if name in values
        }

    progress = Progress(grid.most_runs, 0, refined=True)
    with writing(store) as (writer, _):
        counts = Counts.of(store)
        if not counts.pending and "end" in store.group.attrs:
            return replace(progress, cells=counts.done, done=counts.done)
        with closing(rounds(writer, simulate)) as steps:
            for step in steps:
                progress = replace(
                    progress,
                    cells=step.simulated if step.ended else grid.most_runs,
                    done=step.simulated,
                    ran=step.ran,
                    diverged=step.diverged,
                    blocks=step.blocks,
                    seconds=time.perf_counter() - began,
                    set_aside=(*progress.set_aside, *step.rows),
                )
                on_progress(progress)
        if not progress.set_aside and "end" not in store.group.attrs:
            writer.end(**({} if step.left is None else {BUDGET_LEVEL: step.left}))
    return progress


def recompute(store: Store, blocks: list[int], on_progress: OnProgress) -> list[int]:
    """Run damaged blocks again; returns those whose files differ from the ledger's checksums."""
    before = {row.block: row.files for row in store.rows() if row.block in set(blocks)}
    with writing(store) as (writer, _):
        writer.ledger.delete(blocks)
        for block in blocks:
            for name in store.variables:
                free(store.file(name, block))
    run(store, on_progress, blocks)
    after = {row.block: row.files for row in store.rows()}
    return [b for b, files in before.items() if b in after and after[b] != files]


def _run_blocks(
    writer: Writer, lock: Lock, pending: list[int], unfinished: Mapping[int, Row]
) -> Generator[Committed]:
    """Compute and commit blocks; yields each row and the time at which it was on the disk.

    One thread commits a block while the next one is computed. Closing the generator waits for that
    commit. A block that fails runs again after all others; after ATTEMPTS it is set aside.
    """
    queue = deque((index, 1) for index in pending)

    def commit(values: Values, row: Row) -> Committed:
        return [writer.commit(values, row)], time.perf_counter()

    with ThreadPoolExecutor(1) as pool:
        last: Future[Committed] | None = None
        while queue:
            index, attempt = queue.popleft()
            lock.computing(index)
            values, row = compute(writer.store, index, unfinished.get(index), attempt)
            if row.outcome == SET_ASIDE and attempt < ATTEMPTS:
                queue.append((index, attempt + 1))
                continue
            before, last = last, pool.submit(commit, values, row)
            if before:
                yield before.result()
        if last:
            yield last.result()


def compute(store: Store, index: int, known: Row | None, attempt: int) -> tuple[Values, Row]:
    """Compute the cells of a block that its row, from a smaller store, does not have.

    After an error the row says SET_ASIDE.
    """
    block, began = store.grid.block(index), time.perf_counter()
    before, todo = _done_before(store, known)
    try:
        values = _values(store.grid, block, store.dtype, todo)
    except Exception as error:  # the sweep continues without this block
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:300]
        return set_aside(store, index, known, attempt, reason)
    if before:
        for name in before:
            before[name][todo] = values[name]
        values = before
    return values, Row(index, DONE, seconds=time.perf_counter() - began, attempt=attempt)


def _values(grid: Grid, block: Block, dtype: str, cells: slice | np.ndarray) -> Values:
    """The variables of a block, or of some of its cells; of a reduced block, of all of them."""
    if grid.sweep.reduce:
        return block_values(grid, block, lambda box: _variables(grid.full, box, dtype))
    return _variables(grid, block, dtype, cells)


def _variables(
    grid: Grid, block: Block, dtype: str, cells: slice | np.ndarray = slice(None)
) -> Values:
    """The variables of the scenarios of a block, or of some of its cells."""
    with _precision(dtype):
        return values_of(*_compute(grid, block, dtype, cells), grid.sweep.time.t_end)


def _precision(dtype: str) -> AbstractContextManager[None]:
    """JAX's precision for the numbers of a store, in this thread alone."""
    return jax.enable_x64(dtype == "float64")


def set_aside(
    store: Store, index: int, known: Row | None, attempt: int, reason: str
) -> tuple[Values, Row]:
    """What is committed of a block that can't be computed: what was known, the rest failed."""
    before, todo = _done_before(store, known)
    values = before or no_values(store.grid, index)
    values["status"][todo] = FAILED
    return values, Row(index, SET_ASIDE, attempt=attempt, error=reason)


def _done_before(store: Store, known: Row | None) -> tuple[Values | None, slice | np.ndarray]:
    """The variables of a block that has a row, if its files are intact; the cells to compute."""
    before = read_block(store, known) if known else None
    if before is None:
        return None, slice(None)
    return before, np.isin(before["status"], (OK, DIVERGED), invert=True)


def _compute(
    grid: Grid, block: Block, dtype: str, cells: slice | np.ndarray = slice(None)
) -> tuple[Metrics, Metrics | None]:
    """Metrics of a block, or of some of its cells, and their errors if the sweep wants them."""
    params = vars(grid.params(block, dtype))
    batch = Params(**{name: v[cells] if v.ndim else v for name, v in params.items()})
    return _simulated(grid.sweep, batch, grid.model(block))


def _simulated(plan: Sweep, batch: Params, model: Model) -> tuple[Metrics, Metrics | None]:
    """Metrics of scenarios of one model, and their errors if the sweep wants them."""
    dt, n_steps = plan.time.dt, plan.n_steps
    if plan.error_estimate:
        return sweep(batch, model=model, dt=dt, n_steps=n_steps, error_estimate=True)
    return sweep(batch, model=model, dt=dt, n_steps=n_steps), None


def measure(grid: Grid, dtype: str) -> tuple[float, float]:
    """Seconds before the first result, and scenarios a second, from a short run of the plan."""
    grid = grid.full
    block = next(grid.blocks())
    n = min(cells_of(block), max(MEASURED_STEPS // grid.work, MEASURED_LEAST))
    seconds = []
    for _ in range(2):
        began = time.perf_counter()
        _compute(grid, block, dtype, slice(n))
        seconds.append(time.perf_counter() - began)
    return max(seconds[0] - seconds[1], 0.0), n / seconds[1]
