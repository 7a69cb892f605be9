"""Tables 3 and 4: whole `fic-sweep` processes, in a temporary folder."""

import math
import shutil
import tempfile
from pathlib import Path

from sweeps.bench.plan import DT, Plan, Table, Tell, summary, within
from sweeps.bench.processes import BenchError, Child, Whole, whole
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


def run(plan: Plan, tell: Tell) -> Table:
    """`fic-sweep run` against the bare engine on the same scenarios, and its memory.

    What is compared is the whole process less compiling (tracing, LLVM or XLA, as these
    tell); the second ratio also takes off the start (interpreter and imports).
    """
    wanted = plan.scenarios or (CELLS_FULL if plan.full else CELLS)
    with tempfile.TemporaryDirectory(prefix="fic-sweep-bench-") as name:
        folder = Path(name)
        cells, chunk = _write(folder / "sweep.toml", wanted, plan.steps)
        few_steps = max(plan.steps // MORE, 2)
        more, _ = _write(folder / "more.toml", wanted, few_steps, MORE)
        bare, runs = _in_turn(folder, cells, plan, tell)
        tell(f"run: {more:,} scenarios of {few_steps} steps for their memory")
        larger = _run(folder, "more.toml", "--chunk", str(chunk))
    less = [r.seconds - r.compile_s for r in runs]
    ratio = summary([b / s for b, s in zip(bare, less, strict=True)], max)
    started = [r.seconds - r.compile_s - r.start_s for r in runs]
    peak = max(r.peak_bytes for r in runs)
    return {
        "steps": plan.steps,
        "scenarios": cells,
        "engine_s": summary(bare),
        "run_s": summary([r.seconds for r in runs]),
        "start_s": summary([r.start_s for r in runs]),
        "compile_s": summary([r.compile_s for r in runs]),
        "engine_over_run": ratio | within(ratio["median"], at_least=0.95),
        "engine_over_run_less_start": summary(
            [b / s for b, s in zip(bare, started, strict=True)], max
        ),
        "peak_bytes": {"value": peak} | within(peak, at_most=1.5e9),
        "peak_of_more": {
            "scenarios": more,
            "steps": few_steps,
            "value": larger.peak_bytes,
            "ratio": larger.peak_bytes / peak,
        }
        | within(larger.peak_bytes / peak, at_most=1.1),
        "missing": {},
    }


def first(plan: Plan, tell: Tell) -> Table:
    """How long a whole process takes to a first result, and to its help."""
    taken: dict[str, list[float]] = {"cold": [], "warm": [], "help": []}
    with tempfile.TemporaryDirectory(prefix="fic-sweep-bench-") as name:
        folder = Path(name)
        cells, _ = _write(folder / "sweep.toml", FIRST, plan.steps)
        for i in range(plan.few):
            tell(f"first: round {i + 1} of {plan.few}")
            cache = folder / f"cache{i}"
            cache.mkdir()
            for kind in ("cold", "warm"):
                taken[kind].append(_run(folder, "sweep.toml", cache=cache).seconds)
        for _ in range(plan.repeats):
            taken["help"].append(whole(folder, "--help", cache=folder).seconds)
    names = {
        "cold": (f"run, {cells:,} scenarios, nothing cached", 4.0),
        "warm": (f"run, {cells:,} scenarios, compiled before", 2.0),
        "help": ("--help", 0.25),
    }
    rows = []
    for kind, (told, target) in names.items():
        seconds = summary(taken[kind])
        limits = within(seconds["median"], at_most=target)
        rows.append({"kind": kind, "name": told, "seconds": seconds} | limits)
    return {"steps": plan.steps, "rows": rows, "missing": {}}


def _in_turn(folder: Path, cells: int, plan: Plan, tell: Tell) -> tuple[list[float], list[Whole]]:
    """Seconds of the bare engine and the runs, one of each a round."""
    bare: list[float] = []
    runs: list[Whole] = []
    with Child("engine", plan.steps, file=str(folder / "sweep.toml")) as engine:
        if engine.missing is not None:
            raise BenchError(f"the engine: {engine.missing}")
        rounds = plan.rounds(cells)
        for i in range(rounds):
            tell(f"run: {cells:,} scenarios, round {i + 1} of {rounds}")
            bare.append(engine.seconds(cells))
            runs.append(_run(folder, "sweep.toml", report=True))
    return bare, runs


def _run(
    folder: Path, file: str, *options: str, cache: Path | None = None, report: bool = False
) -> Whole:
    """`fic-sweep run` into a store that is removed again."""
    arguments = ("run", file, "--out", "bench.zarr", *options)
    try:
        return whole(folder, *arguments, cache=cache or folder / "cache", report=report)
    finally:
        shutil.rmtree(folder / "bench.zarr", ignore_errors=True)


def _write(file: Path, cells: int, steps: int, times: int = 1) -> tuple[int, int]:
    """A sweep of about so many cells, `times` as many; its cells and those of a block."""
    side = max(round(cells ** (1 / 3)), 2)
    last = max(round(cells / side**2), 2) * times
    numbers = {"dt": DT, "t_end": round(steps * DT, 9), "side": side, "last": last}
    file.write_text(FILE.format(**numbers), encoding="utf-8")
    grid = Grid(load(file))
    return grid.cells, math.prod(grid.block_shape)
