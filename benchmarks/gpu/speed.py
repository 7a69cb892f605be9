"""Plant steps per second: whole calls, host memory to host memory, and the kernel alone.

The contenders alternate; each has its process, and only one computes at a time. A row's ratios are
of the same round. Where all leaves are columns, a call copies 15 numbers a scenario to the card;
"4 vary" has scalars for the other eleven, as a grid's blocks have.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib import import_module
from time import perf_counter
from typing import Any

import jax
import numpy as np

from benchmarks.child import BenchError, Child, Missing
from benchmarks.gpu.results import missing
from benchmarks.gpu.session import LeftOut, Plan, Session
from benchmarks.implementations import scenarios
from benchmarks.plan import DT
from benchmarks.tables import Row, Table, measured
from fic_jax import Model, Params, sweep
from fic_jax.engine import sweeping
from fic_jax.engine.xla import LANES

ORDERS = ("random", "grid")
# Scenarios, at most, of those that launch kernels for each plant step; XLA's blocks of 128 do so
# one after the other.
FEW_SCANNED, FEW_IN_BLOCKS = 100_000, 16_384
FLOAT64 = 1_000_000  # scenarios, at most, in float64
SLOW = 15.0  # s; a contender whose first call at a size takes longer gets one round
CUDA, SCAN = "CUDA twin", "jit(vmap(scan))"


@dataclass(frozen=True)
class Contender:
    """What computes the metrics, of one precision."""

    name: str
    dtype: str
    backend: Any = None  # of `sweep`
    peer: str | None = None  # the module of benchmarks.peers instead
    located: bool = False  # switches: the integrator rk4_events
    four: bool = False  # four leaves vary, the others are scalars
    most: int | None = None  # scenarios: it gets fewer at the smallest size, and nothing beyond


def contenders(plan: Plan, dtype: str) -> Iterator[Contender]:
    """All of one precision; the first backend's are compared with all others."""
    main, located = plan.backends[0], "rk4_events" in plan.integrators
    most = {name: FEW_IN_BLOCKS for name in plan.backends if name == "xla" != main}
    for name in plan.backends:
        yield Contender(name, dtype, name, most=most.get(name))
        if name == main and dtype == "float32":
            yield Contender(f"{name}, 4 vary", dtype, name, four=True)
    yield Contender(CUDA, dtype, peer="cuda")
    if dtype == "float32":
        yield Contender(SCAN, dtype, peer="plain", most=FEW_SCANNED)
    for name in plan.backends if located else ():
        yield Contender(f"{name}, located", dtype, name, located=True, most=most.get(name))


def measure(session: Session) -> None:
    """Record each round of each contender, size and order of the scenarios."""
    plan = session.plan
    for dtype in plan.dtypes:
        sizes = list(plan.sizes)
        if dtype == "float64":
            sizes = [n for n in sizes if n <= FLOAT64][-1:]
        with ExitStack() as stack:
            racing = _started(session, stack, dtype)
            for n in sizes:
                for order in ORDERS:
                    _race(session, racing, n, order)


def _started(session: Session, stack: ExitStack, dtype: str) -> dict[Contender, Child]:
    """Contenders that have compiled and run once, each with its process."""
    started: dict[Contender, Child] = {}
    n = min(session.plan.sizes)

    def start(one: Contender) -> None:
        child = stack.enter_context(Child())
        try:
            _ask(session, child, one, n, "random")
            started[one] = child
        except (BenchError, Missing, LeftOut) as why:
            session.failed("rates", f"{one.name}, {one.dtype}", why)

    session.say(f"rates: {dtype}: compiling")
    every = list(contenders(session.plan, dtype))
    session.side_by_side(start, every)
    return {one: started[one] for one in every if one in started}


def _race(session: Session, racing: dict[Contender, Child], n: int, order: str) -> None:
    """Record the rounds of those that take so many scenarios; drop one that fails."""
    smallest = min(session.plan.sizes)
    running = [one for one in racing if n <= max(one.most or n, smallest)]
    rounds = {}

    def prepare(one: Contender) -> None:
        case = _case(one, n, order)
        try:
            first = _ask(session, racing[one], one, n, order)
        except (BenchError, Missing, LeftOut) as why:
            session.failed("rates", case, why)
            return
        rounds[one] = 1 if first["whole_s"] > SLOW else session.plan.repeats

    session.say(f"rates: {n:,} scenarios, {order} order, {len(running)} contenders")
    session.side_by_side(prepare, running)
    for i in range(session.plan.repeats):
        for one in running if i % 2 == 0 else reversed(running):  # cancels a drift
            if i >= rounds.get(one, 0):
                continue
            case = _case(one, n, order)
            try:
                taken = _ask(session, racing[one], one, n, order)
            except (BenchError, Missing, LeftOut) as why:
                session.failed("rates", case, why)
                rounds[one] = 0
                continue
            about = {"size": n, "scenarios": _count(one, n), "order": order}
            about["steps"] = session.plan.run_steps
            session.results.add("rates", case, i, **asdict(one), **about, **taken)
    for one in running:
        if one not in rounds:
            del racing[one]  # its process may have ended


def _count(one: Contender, n: int) -> int:
    """Its scenarios at a size of n."""
    return min(n, one.most or n)


def _case(one: Contender, n: int, order: str) -> str:
    return f"{one.name}, {one.dtype}, {n:,} in {order} order"


def _ask(session: Session, child: Child, one: Contender, n: int, order: str) -> Any:
    arguments = {"n": _count(one, n), "order": order, "steps": session.plan.run_steps}
    return session.ask(child, "benchmarks.gpu.speed.timed", **asdict(one), **arguments)


# Called in a child, which measures one contender only:


def timed(n: int, order: str, steps: int, **contender: Any) -> Row:
    """Seconds of a whole call and of the kernel in it, or else in a call of its own."""
    one = Contender(**contender)
    jax.config.update("jax_enable_x64", one.dtype == "float64")
    whole, kernel = prepared(one, n, order, steps)
    began = perf_counter()
    whole()
    taken = {"whole_s": perf_counter() - began}
    return taken | ({"kernel_s": kernel()} if kernel else {})


@lru_cache(maxsize=1)
def prepared(
    one: Contender, n: int, order: str, steps: int, resident: bool = True
) -> tuple[Callable[[], Any], Callable[[], float] | None]:
    """A whole call and, if columns may be resident, seconds of a kernel that has them on the card.

    Raises Missing.
    """
    batch = jax.tree.map(lambda leaf: np.asarray(leaf, one.dtype), scenarios(n, order))
    if not one.four:
        columns = jax.tree.map(lambda leaf: np.array(np.broadcast_to(leaf, n)), batch)
        batch = columns
    if one.peer:
        try:
            peer = import_module(f"benchmarks.peers.{one.peer}")
        except ImportError as error:
            raise Missing(str(error)) from error
        run = peer.prepare(batch, DT, steps)
        seconds = getattr(run, "kernel_seconds", None)
        return run, seconds and (lambda: float(np.min(seconds(1))))
    model = Model(integrator="rk4_events" if one.located else "rk4")

    def whole() -> Any:
        return sweep(batch, model=model, dt=DT, n_steps=steps, backend=one.backend)

    whole()  # compiles
    if one.backend not in ("ptx", "xla", "pallas") or not resident:
        return whole, None
    kernel = _launched if one.backend == "ptx" else _resident
    return whole, kernel(_program(one.backend, model, steps, batch), batch, n)


def _program(backend: Any, model: Model, steps: int, batch: Params) -> Any:
    """The program that `sweep` has compiled."""
    dtype, devices = np.asarray(batch.K0).dtype, tuple(jax.local_devices())
    return sweeping._program(backend, model, steps, False, dtype, devices)


def _launched(program: Any, batch: Params, n: int) -> Callable[[], float]:
    """Seconds of a launch of the kernel, by CUDA events, on columns that are on the card."""
    from cuda.core import Device, EventOptions

    leaves = [*sweeping.columns(vars(batch)), np.asarray(DT, np.asarray(batch.K0).dtype)]
    (kernel, _), *_ = program._compiled.values()
    columns = ExitStack()  # on the card as long as somebody can call `seconds`
    stage, launch, _ = columns.enter_context(kernel.loaded(leaves, n))
    options = EventOptions(timing_enabled=True)
    begin, end = (Device(program._gpus[0]).create_event(options=options) for _ in range(2))

    def seconds(columns: ExitStack = columns) -> float:
        stage.stream.record(begin)
        launch()
        stage.stream.record(end)
        end.sync()
        return (end - begin) / 1000.0

    seconds()  # CUDA loads a kernel at its first launch
    return seconds


def _resident(program: Any, batch: Params, n: int) -> Callable[[], float]:
    """Seconds of the program of XLA or Pallas on columns that are on the device."""
    dt = np.asarray(DT, np.asarray(batch.K0).dtype)
    leaves = sweeping.columns(vars(batch))
    capacity = program.n_devices * program.blocks * LANES
    parts = []
    for start in range(0, n, capacity):
        columns, blocks = program._pack([leaf[start : start + capacity] for leaf in leaves])
        parts.append((jax.device_put(columns, program.sharding), blocks))
    jax.block_until_ready(parts)

    def seconds() -> float:
        began = perf_counter()
        jax.block_until_ready([program.run(columns, dt, blocks) for columns, blocks in parts])
        return perf_counter() - began

    return seconds


# The tables:


def tables(records: list[Row]) -> list[Table]:
    """The targets, and a row for each contender, size and order."""
    if not records:
        return []
    rounds = [r for r in records if "why" not in r]
    notes = [
        "Kernel: by CUDA events for ours and the CUDA twin; for XLA's and Pallas' programs, the "
        "time of a call whose columns are on the card, results left there.",
        *missing(records),
    ]
    steps = rounds[0]["steps"] if rounds else 0
    rates = Table(
        f"Rates: default model, all metrics, {steps:,} steps, in 10^9 plant steps a second",
        [
            ("", "{name}"),
            ("dtype", "{dtype}"),
            ("scenarios", "{scenarios:,}"),
            ("order", "{order}"),
            ("whole call, median", "{whole[median]:.4g}"),
            ("best", "{whole[best]:.4g}"),
            ("kernel, median", "{kernel[median]:.4g}"),
            ("best", "{kernel[best]:.4g}"),
            ("whole / kernel", "{whole_over_kernel:.3f}"),
            ("{main}'s kernel rate / it", "{kernels:.3g}"),
            ("{main}'s whole call / it", "{wholes:.3g}"),
        ],
        _rows(rounds),
        notes,
    )
    main = next((r["backend"] for r in rounds if r["backend"]), "")
    rates.columns[:] = [(heading.replace("{main}", main), form) for heading, form in rates.columns]
    targets = Table(
        "Rates: what is to be reached (median of the rounds; float32, random order)",
        [
            ("", "{name}"),
            ("scenarios", "{scenarios:,}"),
            ("median", "{median:.4g}"),
            ("best", "{best:.4g}"),
            ("target", "{target}"),
            ("met", "{met}"),
        ],
        list(_targets(rounds, main)),
    )
    return [table for table in (targets, rates) if table.rows or table.notes]


def _cases(rounds: list[Row]) -> dict[tuple[str, str, int, str], dict[int, Row]]:
    """Name, dtype, size, order -> round -> record, with rates in 10^9 plant steps a second."""
    cases: dict[tuple[str, str, int, str], dict[int, Row]] = {}
    for r in rounds:
        key = r["name"], r["dtype"], r["size"], r["order"]
        work = r["scenarios"] * r["steps"] / 1e9
        rates = {what: work / r[f"{what}_s"] for what in ("whole", "kernel") if f"{what}_s" in r}
        cases.setdefault(key, {})[r["round"]] = r | rates
    return cases


def _rows(rounds: list[Row]) -> list[Row]:
    cases = _cases(rounds)
    rows = []
    for (name, dtype, size, order), taken in cases.items():
        n = next(iter(taken.values()))["scenarios"]
        row: Row = {"name": name, "dtype": dtype, "scenarios": n, "order": order}
        for what in ("whole", "kernel"):
            if rates := [r[what] for r in taken.values() if what in r]:
                row[what] = measured(rates, max)
        if ratios := _ratios(taken, "whole", taken, "kernel"):
            row["whole_over_kernel"] = measured(ratios)["median"]
        base = cases.get((_baseline(rounds, name), dtype, size, order), {})
        for what in ("whole", "kernel"):
            if base is not taken and (ratios := _ratios(base, what, taken, what)):
                row[f"{what}s"] = measured(ratios)["median"]
        rows.append(row)
    return rows


def _baseline(rounds: list[Row], name: str) -> str:
    """The first backend, with located switches for those that locate them."""
    main = next((r["backend"] for r in rounds if r["backend"]), "")
    return f"{main}, located" if name.endswith(", located") else main


def _ratios(of: dict[int, Row], what: str, over: dict[int, Row], other: str) -> list[float]:
    """One rate over another, in each round that has both."""
    both = [(of[i], over[i]) for i in of if i in over]
    return [a[what] / b[other] for a, b in both if what in a and other in b]


def _targets(rounds: list[Row], main: str) -> Iterator[Row]:
    cases = _cases(rounds)
    sizes = {size for _, dtype, size, _ in cases if dtype == "float32"}
    if not sizes:
        return
    small, large = min(sizes), max(sizes)

    def of(name: str, size: int) -> dict[int, Row]:
        return cases.get((name, "float32", size, "random"), {})

    ours, located, few = of(main, large), of(f"{main}, located", large), of(main, small)
    four = of(f"{main}, 4 vary", large)
    kernels = [r["kernel"] for r in ours.values() if "kernel" in r]
    rows: list[tuple[str, int, list[float], Row]] = [
        (f"{main}, kernel, 10^9 plant steps a second", large, kernels, {"at_least": 50.0}),
        (
            f"{main}'s kernel rate over the CUDA twin's",
            large,
            _ratios(ours, "kernel", of(CUDA, large), "kernel"),
            {"at_least": 0.9},
        ),
        (
            f"whole call's rate over the kernel's: {main}",
            large,
            _ratios(ours, "whole", ours, "kernel"),
            {"at_least": 0.8},
        ),
        (
            f"whole call's rate over the kernel's: {main}, 4 vary",
            large,
            _ratios(four, "whole", four, "kernel"),
            {"at_least": 0.8},
        ),
        (
            f"{main}'s whole call over {SCAN}'s",
            small,
            _ratios(few, "whole", of(SCAN, small), "whole"),
            {"at_least": 50.0},
        ),
        (
            f"located switches, time over rk4's, kernel: {main}",
            large,
            _ratios(ours, "kernel", located, "kernel"),
            {"at_most": 1.5},
        ),
        (
            f"located switches, time over rk4's, whole call: {main}",
            large,
            _ratios(ours, "whole", located, "whole"),
            {"at_most": 1.5},
        ),
    ]
    for name, size, values, target in rows:
        if values:
            best = min if "at_most" in target else max
            yield {"name": name, "scenarios": size} | measured(values, best, **target)
