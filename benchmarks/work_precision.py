"""Error against cost: what a plant step, and what a second of one core, buys.

    python -m benchmarks.work_precision [--scenarios N] [--only METHOD] [--out FILE.png]

The error is that of nmse, an integral over the motion, relative to its converged value:
`rk4_events` with 32 plant steps per control period. A scenario is regular if 16 steps give the same
value within 1e-5; a limit cycle has no converged value, so it is not regular. All runs share the
control period (10 ms for 10 s) and the metric: only the integration differs.

The cost is processor time of one core in float64, without compiling. rk4 and rk4_events are
`fic_jax.sweep`, as its users run it. diffrax runs vmapped over blocks of scenarios that advance
together, in a process with the flags of `tune_for_throughput`; with events it runs without them, as
XLA can't compile it with them. The Taylor series are plain Python (tests/reference) and share no
code with the rest: their error is that of the converged value.
The command needs the source checkout and the extra `bench`.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import fic_jax
from benchmarks import solvers
from benchmarks.child import Child
from benchmarks.machine import machine
from benchmarks.scenarios import N_PERIODS, PERIOD, Kind, kinds
from benchmarks.tables import Row, Table, render
from fic_jax import QUANTITIES, Model, Params
from fic_jax.engine.xla import LANES
from figures.style import COLUMN_WIDTH, SMALL_SIZE, look, save
from tests.reference.events import Irregular
from tests.reference.taylor import ORDER

SEED = 7
CONVERGED, NEARLY = 32, 16  # plant steps per control period
REGULAR = 1e-5  # relative difference of nmse between them
LONG = 3.0  # s, a run that takes longer is not repeated
REPEATS = 3


COLUMNS = [
    ("method", "{method}"),
    ("setting", "{setting}"),
    ("median error", "{median:.1e}"),
    ("90th percentile", "{high:.1e}"),
    ("µs per scenario", "{microseconds:,.10g}"),
]


@dataclass(frozen=True)
class Method:
    """One curve: a solver and its settings, from coarse to fine."""

    name: str
    setting: str  # in words, a format
    settings: tuple[float, ...]
    colour: str  # Okabe and Ito 2008 and Tol 2021, safe for colour-blind readers
    marker: str
    tuned: bool = True  # whether the process has the engine's flags
    scenarios: int | None = None  # at most so many of each kind


STEPS = "{:g} steps per 10 ms"
METHODS = (
    Method("rk4", STEPS, (1, 2, 4, 8, 16), "#0072B2", "o"),
    Method("rk4_events", STEPS, (1, 2, 4, 8, 16), "#D55E00", "s"),
    Method("diffrax, constant", STEPS, (1, 2, 4, 8, 16), "#AA4499", "^"),
    Method("diffrax, events", "rtol {:g}", (1e-2, 1e-4, 1e-7), "#009E73", "v", False, LANES),
    Method("Taylor, events", "order {:g}", (ORDER,), "#000000", "D", scenarios=8),
)


def rows(methods: tuple[Method, ...], n: int) -> list[Row]:
    """The points of all curves, from `n` scenarios of each kind."""
    with Child() as child:
        child.call("benchmarks.work_precision.start", tuned=True)
        nearly, converged = (
            np.array(_measured(child, "rk4_events", steps, n, n)["nmse"])
            for steps in (NEARLY, CONVERGED)
        )
    regular = np.abs(nearly / converged - 1.0) < REGULAR
    for kind, good in zip(_kinds(n), regular, strict=True):
        sys.stderr.write(f"{kind.name}: {good.sum()} of {good.size} regular\n")
    points = []
    for method in methods:
        some = min(method.scenarios or n, n)
        exact, good = converged[:, :some], regular[:, :some]
        with Child() as child:
            child.call("benchmarks.work_precision.start", tuned=method.tuned)
            for setting in method.settings:
                words = method.setting.format(setting)
                sys.stderr.write(f"{method.name}: {words}\n")
                answer = _measured(child, method.name, setting, n, some)
                errors = np.abs(np.array(answer["nmse"]) / exact - 1.0)[good]
                errors[~np.isfinite(errors)] = np.inf  # a run that failed counts as the worst
                median, high = np.percentile(errors, [50, 90])
                points.append(
                    {
                        "method": method.name,
                        "setting": words,
                        "median": float(median),
                        "high": float(high),
                        "microseconds": float(f"{1e6 * answer['seconds']:.3g}"),
                    }
                )
    return points


def _measured(child: Child, name: str, setting: float, n: int, some: int) -> Row:
    return child.call("benchmarks.work_precision.run", name=name, setting=setting, n=n, some=some)


def plot(points: list[Row]) -> Figure:
    """Error of nmse over cost, one curve for each method."""
    with look():
        figure = Figure(figsize=(COLUMN_WIDTH, 2.9))
        axes = figure.add_subplot()
        axes.set(xscale="log", yscale="log")
        most = max(p["microseconds"] for p in points)
        for method in METHODS:
            curve = [p for p in points if p["method"] == method.name]
            if curve:
                _draw(axes, method, curve, most)
        axes.set_xlabel("processor time per scenario of 10 s (µs)")
        axes.set_ylabel("relative error of nmse (1)")
        axes.grid(color="0.9", linewidth=0.4)
        axes.set_axisbelow(True)
        key = "filled: median\nopen: 90th percentile"
        axes.text(0.98, 0.98, key, transform=axes.transAxes, ha="right", va="top", color="0.3")
        return figure


def _draw(axes: Axes, method: Method, points: list[Row], most: float) -> None:
    """One curve and its name: right of the last point, or left of it near the end of the axis."""
    costs = [p["microseconds"] for p in points]
    kind: dict[str, Any] = {"color": method.colour, "marker": method.marker, "markersize": 3.0}
    axes.plot(costs, [p["high"] for p in points], **kind, lw=0.8, alpha=0.5, ls="--", mfc="white")
    axes.plot(costs, [p["median"] for p in points], **kind, lw=1.0)
    ends = costs[-1] > 0.3 * most
    axes.annotate(
        method.name,
        (costs[-1], points[-1]["median"]),
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
    # 6 blocks of the engine each, together 2,304
    parser.add_argument("--scenarios", type=int, default=6 * LANES, help="of each kind")
    names = [method.name for method in METHODS]
    parser.add_argument("--only", action="append", choices=names, help="this method; repeatable")
    parser.add_argument("--out", type=Path, help="write the figure here (.png, .pdf or .svg)")
    form = parser.add_mutually_exclusive_group()
    for name in ("json", "markdown"):
        form.add_argument(f"--{name}", dest="form", action="store_const", const=name)
    arguments = parser.parse_args()
    before = machine()
    methods = tuple(m for m in METHODS if not arguments.only or m.name in arguments.only)
    points = rows(methods, arguments.scenarios)
    title = f"Error of nmse against cost, {3 * arguments.scenarios:,} scenarios"
    table = Table(title, COLUMNS, points)
    sys.stdout.write(render(before, {"precision": table}, arguments.form or "text") + "\n")
    if arguments.out:
        save(plot(points), arguments.out)


# Called in a child:


def start(tuned: bool) -> None:
    """Use one core, float64, and the engine's flags or none."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if tuned:
        fic_jax.tune_for_throughput(1)
    jax.config.update("jax_enable_x64", True)


def run(name: str, setting: float, n: int, some: int) -> Row:
    """nmse [kind, some] of the first of `n` seeded scenarios of each kind, and seconds for each."""
    by = {"rk4": _by_engine, "rk4_events": _by_engine, "Taylor, events": _by_taylor}
    one_model = by.get(name, _by_diffrax)
    parts: list[tuple[np.ndarray, float]] = []
    for model, same in groupby(_kinds(n), key=lambda kind: kind.model):
        stacks = [np.stack(jax.tree.leaves(kind.batch))[:, :some] for kind in same]
        parts.append(one_model(name, setting, model, np.concatenate(stacks, axis=1)))
    nmse = np.concatenate([part for part, _ in parts])
    seconds = sum(each * len(part) for part, each in parts) / len(nmse)
    return {"nmse": nmse.reshape(-1, some).tolist(), "seconds": seconds}


@lru_cache
def _kinds(n: int) -> list[Kind]:
    return kinds(n, SEED)


def _by_engine(
    name: str, setting: float, model: Model, columns: np.ndarray
) -> tuple[np.ndarray, float]:
    """nmse of [field, N] scenarios, and seconds for each."""
    model = replace(model, integrator=name)  # type: ignore[arg-type]
    batch = Params(**dict(zip(QUANTITIES, columns, strict=True)))
    dt, n_steps = PERIOD / setting, int(N_PERIODS * setting)

    def sweep() -> np.ndarray:
        return np.asarray(fic_jax.sweep(batch, model=model, dt=dt, n_steps=n_steps).nmse)

    sweep()  # compiles
    return _timed(sweep)


def _by_diffrax(
    name: str, setting: float, model: Model, columns: np.ndarray
) -> tuple[np.ndarray, float]:
    """As `_by_engine`, in blocks of lanes."""
    n = columns.shape[1]
    whole = np.pad(columns, ((0, 0), (0, -n % LANES)), mode="edge")
    blocks = np.moveaxis(whole.reshape(len(whole), -1, LANES), 1, 0)
    constant = name == "diffrax, constant"
    one = (
        solvers.constant_steps(model, int(setting))
        if constant
        else solvers.adaptive_with_events(model, setting)
    )

    def block(columns: jax.Array) -> jax.Array:
        return jax.vmap(one)(Params(**dict(zip(QUANTITIES, columns, strict=True))))

    def batch(blocks: jax.Array) -> jax.Array:
        return jax.lax.map(block, blocks)

    program = jax.jit(batch).lower(blocks).compile()
    nmse, seconds = _timed(lambda: np.asarray(program(blocks)).ravel())
    return nmse[:n], seconds


def _timed(run: Callable[[], np.ndarray]) -> tuple[np.ndarray, float]:
    """What a run returns, and its least processor time in seconds for each of its scenarios."""
    fastest = np.inf
    for _ in range(REPEATS):
        start = time.process_time()
        nmse = run()
        fastest = min(fastest, time.process_time() - start)
        if fastest > LONG:
            break
    return nmse, fastest / len(nmse)


def _by_taylor(
    name: str, setting: float, model: Model, columns: np.ndarray
) -> tuple[np.ndarray, float]:
    """As `_by_engine`; nmse is NaN where a scenario chatters."""
    start, nmse = time.process_time(), np.full(columns.shape[1], np.nan)
    for i, column in enumerate(columns.T):
        p = Params(**dict(zip(QUANTITIES, column, strict=True)))
        with suppress(Irregular):
            nmse[i] = solvers.by_taylor_series(p, model)
    return nmse, (time.process_time() - start) / len(nmse)


if __name__ == "__main__":
    main()
