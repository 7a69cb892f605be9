"""`fic-sweep run` as whole processes, in a temporary folder: a long run, the first result."""

import math
import shutil
import tempfile
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np

import fic_jax
from benchmarks.child import Child
from benchmarks.fic_sweep import timed
from benchmarks.plan import DT, Plan, Say
from benchmarks.tables import Row, Table, measured
from fic_jax import Params
from sweeps.plan.grid import Grid
from sweeps.spec.reading import load

CELLS, CELLS_FULL = 1_000_000, 4_000_000
FIRST = 1_000  # cells of a first result
MORE = 16  # times the cells, at a 16th of the steps; a power of two leaves the blocks as they are
FILE = """\
name = "bench"
[time]
dt = {dt}
t_end = {t_end}
[axes]
K0 = {{ log = [1.0, 1000.0], n = {side} }}
Kenv = {{ log = [10.0, 1000.0], n = {side} }}
Td = {{ lin = [1.0, 20.0], n = {last} }}
"""


def run(plan: Plan, say: Say) -> Table:
    """`fic-sweep run` and, in the same round, the bare engine on the same scenarios; memory.

    The first ratio takes compiling off the time of the process; the second also takes off the
    start, the interpreter and its imports.
    """
    wanted = plan.scenarios or (CELLS_FULL if plan.full else CELLS)
    bare: list[float] = []
    runs: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="fic-sweep-bench-") as name, Child() as child:
        folder = Path(name)
        grid = _write(folder / "sweep.toml", wanted, plan.steps)
        few_steps = max(plan.steps // MORE, 2)
        more = _write(folder / "more.toml", wanted, few_steps, MORE).cells
        engine = {"file": str(folder / "sweep.toml"), "steps": plan.steps}
        say(f"run: {grid.cells:,} scenarios, compiling")
        child.call("benchmarks.whole_runs.bare_engine", **engine)
        rounds = plan.rounds(grid.cells)
        for i in range(rounds):
            say(f"run: {grid.cells:,} scenarios, round {i + 1} of {rounds}")
            bare.append(child.call("benchmarks.whole_runs.bare_engine", **engine))
            runs.append(_run(folder, "sweep.toml", report=True))
        say(f"run: {more:,} scenarios of {few_steps} steps for their memory")
        block = str(math.prod(grid.block_shape))
        larger = _run(folder, "more.toml", "--chunk", block)["peak_bytes"]
    start, compiling, whole = ([r[k] for r in runs] for k in ("start_s", "compile_s", "seconds"))
    rest = [w - c for w, c in zip(whole, compiling, strict=True)]
    ratios = [b / r for b, r in zip(bare, rest, strict=True)]
    without_start = [b / (r - s) for b, r, s in zip(bare, rest, start, strict=True)]
    peak = max(r["peak_bytes"] for r in runs)
    rows: dict[str, Row] = {
        "bare engine, s": measured(bare),
        "fic-sweep run, whole process, s": measured(whole),
        "  of it starting: interpreter, imports": measured(start),
        "  of it compiling": measured(compiling),
        "engine / (whole less compiling)": measured(ratios, max, at_least=0.95),
        "engine / (whole less compiling and starting)": measured(without_start, max),
        "peak memory, MB": measured([peak / 1e6], at_most=1500),
        f"  with {more:,} scenarios of {few_steps:,} steps": measured([larger / 1e6]),
        "  ratio of the two": measured([larger / peak], at_most=1.1),
    }
    title = f"A run of {grid.cells:,} scenarios of {plan.steps:,} steps into a store"
    return _table(title, rows, "{%s:.4g}")


def first(plan: Plan, say: Say) -> Table:
    """How long a whole process takes to a first result, and to its help."""
    taken: dict[str, list[float]] = {"cold": [], "warm": [], "help": []}
    with tempfile.TemporaryDirectory(prefix="fic-sweep-bench-") as name:
        folder = Path(name)
        cells = _write(folder / "sweep.toml", FIRST, plan.steps).cells
        for i in range(plan.few):
            say(f"first: round {i + 1} of {plan.few}")
            for kind in ("cold", "warm"):
                taken[kind].append(_run(folder, "sweep.toml", cache=f"cache{i}")["seconds"])
        for _ in range(plan.repeats):
            taken["help"].append(timed("--help", cache=str(folder / "cache"))["seconds"])
    rows = {
        f"run, {cells:,} scenarios, nothing cached": measured(taken["cold"], at_most=4.0),
        f"run, {cells:,} scenarios, compiled before": measured(taken["warm"], at_most=2.0),
        "--help": measured(taken["help"], at_most=0.25),
    }
    title = f"First result: whole processes of fic-sweep, {plan.steps:,} steps, in seconds"
    return _table(title, rows, "{%s:.2f}")


def _table(title: str, rows: dict[str, Row], number: str) -> Table:
    columns = [("", "{name}"), ("median", number % "median"), ("best", number % "best")]
    columns += [("target", "{target}"), ("met", "{met}")]
    return Table(title, columns, [{"name": name} | row for name, row in rows.items()])


def _run(folder: Path, file: str, *options: str, cache: str = "cache", report: bool = False) -> Any:
    """`fic-sweep run` into a store that is then removed."""
    store = folder / "bench.zarr"
    command = ("run", str(folder / file), "--out", str(store), *options)
    try:
        return timed(*command, cache=str(folder / cache), report=report)
    finally:
        shutil.rmtree(store, ignore_errors=True)


def _write(file: Path, cells: int, steps: int, times: int = 1) -> Grid:
    """Write a sweep of about so many cells, `times` as many."""
    side = max(round(cells ** (1 / 3)), 2)
    last = max(round(cells / side**2), 2) * times
    numbers = {"dt": DT, "t_end": round(steps * DT, 9), "side": side, "last": last}
    file.write_text(FILE.format(**numbers), encoding="utf-8")
    return Grid(load(file))


def bare_engine(file: str, steps: int) -> float:
    """Called in a child: seconds of `fic_jax.sweep` of every scenario of a sweep file."""
    batch = _scenarios(file)
    began = perf_counter()
    fic_jax.sweep(batch, dt=DT, n_steps=steps)
    return perf_counter() - began


@lru_cache
def _scenarios(file: str) -> Params:
    fic_jax.tune_for_throughput()
    grid = Grid(load(Path(file)))
    batch = grid.params(tuple(slice(0, n) for n in grid.shape))
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), batch)
