"""From a sweep to a store: plan, blocks, engine, commit. Prints nothing; tells a callback."""

import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import jax
import numpy as np

from fic_jax import Metrics, Params, sweep, tune_for_throughput
from fic_jax.stiffness import fastest_rate
from sweeps.cache import programs
from sweeps.grid import Block, Grid
from sweeps.layout import create
from sweeps.provenance import IDENTITY, provenance
from sweeps.spec import Sweep, SweepError
from sweeps.store import Store, open_store
from sweeps.validation import out_of_bounds

STABLE = 2.78  # |lambda| dt beyond which RK4 diverges on a linear system
ACCURATE = 1.0  # |lambda| dt up to which a step resolves it

MEASURED_STEPS = 30_000_000  # plant steps of a dry run's measurement, some tenths of a second
MEASURED_LEAST = 512  # scenarios, so that no device has idle lanes


@dataclass(frozen=True)
class Progress:
    """Told once before the first block and once after each that is on disk."""

    cells: int  # of the whole sweep
    done: int  # cells in the store
    ran: int  # cells done by this run
    diverged: int  # among them
    seconds: float  # since this run began


Tell = Callable[[Progress], None]


def configure(precision: int) -> None:
    """Set JAX up for sweeps, with programs kept from run to run; before JAX starts."""
    tune_for_throughput()
    jax.config.update("jax_enable_x64", precision == 64)
    kept = programs()
    own = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if kept is not None and not own:
        jax.config.update("jax_compilation_cache_dir", str(kept))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def start(path: Path, plan: Sweep, chunk: int | None, precision: int) -> Store:
    """Make the store of a new run. Raises SweepError if it can't be."""
    for problem in out_of_bounds(plan, f"float{precision}"):
        raise SweepError(f"{plan.name} in {precision} bits: {problem}")
    attributes = provenance(precision) | {"start": _now()}
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


def run(store: Store, tell: Tell) -> Progress:
    """Run every block that is not done and commit it; safe to interrupt between any two lines."""
    grid, began = store.grid, time.perf_counter()
    pending = store.pending()
    todo = sum(_cells(block) for block in pending)
    progress = Progress(grid.cells, grid.cells - todo, 0, 0, 0.0)
    tell(progress)
    with closing(_committed(store, pending)) as committed:
        for block, lost, when in committed:
            ran, diverged = progress.ran + _cells(block), progress.diverged + lost
            seconds = when - began
            progress = Progress(grid.cells, grid.cells - todo + ran, ran, diverged, seconds)
            tell(progress)
    if "end" not in store.group.attrs:  # also where an interruption came just before this line
        store.note(end=_now())
    return progress


def _committed(store: Store, pending: list[Block]) -> Generator[tuple[Block, int, float]]:
    """Compute the blocks and commit them: each, its diverged scenarios, and when it was on disk.

    A block is written while the next one is computed, and told of after that. Whoever stops
    asking loses none that is computed: closing waits until it is written.
    """

    def write(block: Block, metrics: Metrics, errors: Metrics | None) -> tuple[int, float]:
        return store.write(block, metrics, errors), time.perf_counter()

    with ThreadPoolExecutor(1) as writer:
        last: tuple[Block, Future[tuple[int, float]]] | None = None
        for block in pending:
            result = _compute(store.grid, block, store.dtype)
            before, last = last, (block, writer.submit(write, block, *result))
            if before:
                yield before[0], *before[1].result()
        if last:
            yield last[0], *last[1].result()


def _compute(
    grid: Grid, block: Block, dtype: str, n: int | None = None
) -> tuple[Metrics, Metrics | None]:
    """Metrics of a block, or of its first `n` scenarios, and their errors where wanted.

    In the precision of the store.
    """
    params = {name: np.asarray(v, dtype) for name, v in vars(grid.params(block)).items()}
    batch = Params(**{name: v[:n] if v.ndim else v for name, v in params.items()})
    plan = grid.sweep
    model, dt, n_steps = grid.model(block), plan.time.dt, plan.n_steps
    if plan.error_estimate:
        return sweep(batch, model=model, dt=dt, n_steps=n_steps, error_estimate=True)
    return sweep(batch, model=model, dt=dt, n_steps=n_steps), None


def measure(grid: Grid, dtype: str) -> tuple[float, float]:
    """Seconds before the first result, and scenarios a second, from a short run of the plan."""
    block = next(grid.blocks())
    n = min(_cells(block), max(MEASURED_STEPS // grid.work, MEASURED_LEAST))
    seconds = []
    for _ in range(2):
        began = time.perf_counter()
        _compute(grid, block, dtype, n)
        seconds.append(time.perf_counter() - began)
    return max(seconds[0] - seconds[1], 0.0), n / seconds[1]


def warnings_of(plan: Sweep) -> Iterator[str]:
    """What is allowed but should be known: a non-monotone profile, a coarse dt."""
    p = plan.extremes()
    with np.errstate(all="ignore"):  # extremes may overflow; the comparison still stands
        overshoot = np.max(np.asarray(p.K0) * np.asarray(p.x0) / np.asarray(p.Fmax))
        stiffest = fastest_rate(p) * plan.time.dt
    if overshoot > 1.0:
        yield (
            f"K0*x0 reaches {overshoot:.3g} times Fmax: there the force profile (eq. 1) is not "
            "monotone and the torque is cut off at Fmax"
        )
    if stiffest > ACCURATE:
        state = "unstable" if stiffest > STABLE else "inaccurate"
        yield (
            f"dt = {plan.time.dt:g} s is {stiffest:.3g} times the time constant of the stiffest "
            f"scenario: RK4 is {state} there (it resolves up to {ACCURATE:g}, diverges beyond "
            f"{STABLE:g}); dt = {plan.time.dt / stiffest:.2g} s would do"
        )


def _cells(block: Block) -> int:
    return int(np.prod([part.stop - part.start for part in block], dtype=np.int64))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
