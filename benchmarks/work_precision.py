"""Error against cost: what a plant step, and what a second of one core, buys.

    python -m benchmarks.work_precision [--quick] [--out FILE.png]

Error is that of nmse, relative to its converged value: `rk4_events` with 32 plant steps per
sample. A scenario is regular where 16 steps give the same within 1e-5; a limit cycle has no
converged value and does not. Period, samples (every 10 ms for 10 s) and metric stay the same in
all runs, only the integration changes.

Cost is the processor time of one core in float64, compilation aside. All JAX methods run as
the engine runs a block, vmapped over lanes that advance together, in a process with the flags
of `tune_for_throughput`; diffrax with events in one without, as XLA can't compile it with them.
scipy is independent of all else (tests/reference): its error is that of the converged value.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import fic_jax
from benchmarks import solvers
from benchmarks.scenarios import N_SAMPLES, PERIOD, Kind, kinds
from fic_jax import QUANTITIES, Model, Params
from fic_jax.engine.sweeping import UNROLL
from fic_jax.engine.xla import LANES
from fic_jax.metrics import compiled_evaluate
from figures.style import COLUMN_WIDTH, RC, SMALL_SIZE, save
from tests.reference.events import Irregular

SEED = 7
CONVERGED, NEARLY = 32, 16  # plant steps per sample
REGULAR = 1e-5  # relative difference of nmse between them
LONG = 3.0  # s, a run that takes longer is not repeated
REPEATS = 3


@dataclass(frozen=True)
class Method:
    """One curve: a solver and its settings, from coarse to fine."""

    name: str
    unit: str
    settings: tuple[float, ...]
    colour: str  # Okabe and Ito 2008 and Tol 2021, told apart by all
    marker: str
    tuned: bool = True  # whether the process takes the engine's flags
    scenarios: int | None = None  # of each kind, None for all


METHODS = (
    Method("rk4", "steps per 10 ms", (1, 2, 4, 8, 16), "#0072B2", "o"),
    Method("rk4_events", "steps per 10 ms", (1, 2, 4, 8, 16), "#D55E00", "s"),
    Method("diffrax, constant", "steps per 10 ms", (1, 2, 4, 8, 16), "#AA4499", "^"),
    Method("diffrax, events", "rtol", (1e-2, 1e-4, 1e-7), "#009E73", "v", False, LANES),
    Method("scipy, events", "rtol", (1e-6,), "#000000", "D", scenarios=8),
)


@dataclass(frozen=True)
class Point:
    """One row of the table, one point of a curve."""

    method: Method
    setting: float
    median: float  # relative error of nmse
    high: float  # 90th percentile
    microseconds: float  # per scenario


def scenario(name: str, setting: float, model: Model) -> solvers.Scenario:
    """nmse of one scenario by a JAX method."""
    if name == "diffrax, constant":
        return solvers.constant_steps(model, int(setting))
    if name == "diffrax, events":
        return solvers.adaptive_with_events(model, setting)
    model = Model(contact=model.contact, integrator="rk4" if name == "rk4" else "rk4_events")
    unroll = UNROLL[model.integrator] if setting == 1 else 1
    dt, substeps = np.float64(PERIOD), int(setting)

    def one(p: Params) -> jax.Array:
        return compiled_evaluate(p, model, dt, N_SAMPLES, substeps, unroll).nmse

    return one


def run(name: str, setting: float, some: list[Kind]) -> tuple[np.ndarray, float]:
    """nmse of the scenarios of all kinds, one after the other, and mean seconds for each."""
    one_model = _by_scipy if name == "scipy, events" else _by_jax
    parts = []
    for model, same in groupby(some, key=lambda kind: kind.model):
        stacks = [np.stack(jax.tree.leaves(kind.batch)) for kind in same]
        parts.append(one_model(name, setting, model, np.concatenate(stacks, axis=1)))
    nmse = [part[0] for part in parts]
    return np.concatenate(nmse), sum(part[1] * len(part[0]) for part in parts) / sum(map(len, nmse))


def _by_jax(
    name: str, setting: float, model: Model, columns: np.ndarray
) -> tuple[np.ndarray, float]:
    """nmse of [field, N] scenarios, and the seconds for each: in blocks of lanes, as the engine."""
    n = columns.shape[1]
    whole = np.pad(columns, ((0, 0), (0, -n % LANES)), mode="edge")
    blocks = np.moveaxis(whole.reshape(len(whole), -1, LANES), 1, 0)
    one = scenario(name, setting, model)

    def block(columns: jax.Array) -> jax.Array:
        return jax.vmap(one)(Params(**dict(zip(QUANTITIES, columns, strict=True))))

    def batch(blocks: jax.Array) -> jax.Array:
        return jax.lax.map(block, blocks)

    program = jax.jit(batch).lower(blocks).compile()
    nmse, seconds = _timed(lambda: np.asarray(program(blocks)).ravel())
    return nmse[:n], seconds / whole.shape[1]


def _timed(call: Callable[[], np.ndarray]) -> tuple[np.ndarray, float]:
    """What a call returns, and the processor time of the fastest of some."""
    fastest = np.inf
    for _ in range(REPEATS):
        start = time.process_time()
        out = call()
        fastest = min(fastest, time.process_time() - start)
        if fastest > LONG:
            break
    return out, fastest


def _by_scipy(
    name: str, setting: float, model: Model, columns: np.ndarray
) -> tuple[np.ndarray, float]:
    start = time.process_time()
    nmse = np.array([_one_by_scipy(column, model, setting) for column in columns.T])
    return nmse, (time.process_time() - start) / len(nmse)


def _one_by_scipy(column: np.ndarray, model: Model, rtol: float) -> float:
    p = Params(**dict(zip(QUANTITIES, column, strict=True)))
    try:
        return solvers.located_by_scipy(p, model, rtol)
    except Irregular:
        return np.nan


def start(tuned: bool) -> None:
    """Settings of a measuring process: one core, float64, the engine's flags or none."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if tuned:
        fic_jax.tune_for_throughput(1)
    jax.config.update("jax_enable_x64", True)


def measured(
    name: str, settings: Iterable[float], some: list[Kind], tuned: bool
) -> list[tuple[np.ndarray, float]]:
    """`run` of every setting, in a process of its own."""
    with ProcessPoolExecutor(1, get_context("spawn"), start, (tuned,)) as pool:
        return list(pool.map(partial(run, name, some=some), settings))


def first(kind: Kind, n: int) -> Kind:
    """The first n scenarios of a kind."""
    return Kind(kind.name, jax.tree.map(lambda leaf: leaf[:n], kind.batch), kind.model)


def curve(
    method: Method, some: list[Kind], converged: np.ndarray, regular: np.ndarray
) -> list[Point]:
    """The points of a method; `converged` and `regular` are [kind, N]."""
    n = method.scenarios or converged.shape[1]
    exact, good = converged[:, :n].ravel(), regular[:, :n].ravel()
    points = []
    rows = measured(method.name, method.settings, [first(kind, n) for kind in some], method.tuned)
    for setting, (nmse, seconds) in zip(method.settings, rows, strict=True):
        errors = np.abs(nmse / exact - 1.0)[good]
        errors[~np.isfinite(errors)] = np.inf  # a run that failed counts as the worst
        median, high = np.percentile(errors, [50, 90])
        points.append(Point(method, setting, float(median), float(high), 1e6 * seconds))
    return points


def table(points: list[Point]) -> str:
    """The points as Markdown."""
    head = ["method", "setting", "median error", "90th percentile", "µs per scenario"]
    rows = [head, ["---"] * 2 + ["---:"] * 3]
    for p in points:
        setting = f"{p.setting:g} {p.method.unit}"
        if p.method.unit == "rtol":
            setting = f"rtol {p.setting:g}"
        rows.append([p.method.name, setting, f"{p.median:.1e}", f"{p.high:.1e}", cost(p)])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def cost(p: Point) -> str:
    """Microseconds to three digits, not in powers of ten."""
    return f"{float(f'{p.microseconds:.3g}'):,.10g}"


def plot(points: list[Point]) -> Figure:
    """Error of nmse over cost, one curve for each method."""
    with rc_context(RC):
        figure = Figure(figsize=(COLUMN_WIDTH, 2.9))
        axes = figure.add_subplot()
        axes.set(xscale="log", yscale="log")
        most = max(p.microseconds for p in points)
        for method in dict.fromkeys(p.method for p in points):
            _draw(axes, [p for p in points if p.method == method], most)
        axes.set_xlabel("processor time per scenario of 10 s (µs)")
        axes.set_ylabel("relative error of nmse (1)")
        axes.grid(color="0.9", linewidth=0.4)
        axes.set_axisbelow(True)
        key = "filled: median\nopen: 90th percentile"
        axes.text(0.98, 0.98, key, transform=axes.transAxes, ha="right", va="top", color="0.3")
        return figure


def _draw(axes: Axes, points: list[Point], most: float) -> None:
    """One curve and its name: right of the last point, left of it where the axis ends."""
    method, last = points[0].method, points[-1]
    costs = [p.microseconds for p in points]
    look: dict[str, Any] = {"color": method.colour, "marker": method.marker, "markersize": 3.0}
    axes.plot(costs, [p.high for p in points], **look, lw=0.8, alpha=0.5, ls="--", mfc="white")
    axes.plot(costs, [p.median for p in points], **look, lw=1.0)
    ends = last.microseconds > 0.3 * most
    axes.annotate(
        method.name,
        (last.microseconds, last.median),
        xytext=(-4 if ends else 4, 0),
        textcoords="offset points",
        ha="right" if ends else "left",
        va="center",
        color=method.colour,
        fontsize=SMALL_SIZE,
    )


def main() -> None:
    """Measure, print the table, draw the figure."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--quick", action="store_true", help="few scenarios, coarse numbers")
    parser.add_argument("--out", type=Path, help="write the figure here (.png, .pdf or .svg)")
    arguments = parser.parse_args()
    # 6 blocks of the engine each, together 2,304
    all_kinds = kinds(LANES if arguments.quick else 6 * LANES, SEED)
    fixed = measured("rk4_events", (NEARLY, CONVERGED), all_kinds, True)
    nearly, converged = (nmse.reshape(len(all_kinds), -1) for nmse, _ in fixed)
    regular = np.abs(nearly / converged - 1.0) < REGULAR
    for kind, good in zip(all_kinds, regular, strict=True):
        sys.stdout.write(f"{kind.name}: {good.sum()} of {good.size} regular\n")
    points = []
    for method in METHODS:
        points += curve(method, all_kinds, converged, regular)
    sys.stdout.write("\n" + table(points) + "\n")
    if arguments.out:
        save(plot(points), arguments.out)


if __name__ == "__main__":
    main()
