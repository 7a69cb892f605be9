"""`python -m benchmarks.gpu` without a card: the harness on the CPU, at sizes that mean nothing."""

import itertools
import json
import os
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from time import monotonic

import jax
import numpy as np
import pytest

from benchmarks.child import BenchError, Child
from benchmarks.gpu import agreement, memory, speed
from benchmarks.gpu.__main__ import PARTS
from benchmarks.gpu.agreement import UNLIKE, apart, differences
from benchmarks.gpu.results import Results, missing
from benchmarks.gpu.session import LeftOut, Plan, Session
from benchmarks.scenarios import wide
from fic_jax import CHOICES, METRICS, Metrics
from fic_jax.engine import sweeping
from tests.lanes import card

ROOT = Path(__file__).parents[2]
SMALL = (
    *("--scenarios", "16", "--steps", "4", "--bits", "16", "--run-steps", "4"),
    *("--sizes", "16", "32", "--repeats", "2", "--jobs", "2"),
    *("--dtype", "float32", "--integrator", "rk4", "--reading", "contact=welded"),
)


def command(folder, *arguments):
    """Run it in another folder, on a machine without a card; XLA optimises little."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "JAX_PLATFORMS": "cpu",
        "PATH": str(folder),  # no nvidia-smi on it
    }
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.gpu", "--out", "out", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def records(folder, part):
    return Results(folder / "out").of(part)


def test_every_part_that_needs_no_card(tmp_path):
    done = command(tmp_path, "--cpu", *SMALL)
    assert done.returncode == 0, done.stderr
    (machine,) = records(tmp_path, "machine")
    assert machine["facts"]["JAX's devices"].endswith("(cpu)")
    (bits,), (welded,) = (records(tmp_path, part) for part in ("bits", "correctness"))
    assert welded["case"] == "xla, rk4, float32, contact=welded" and welded["run_s"] > 0
    for row in (bits, welded):  # XLA rounds differently, but simulates the same
        assert row["scenarios"] == 16 and row["finite_differs"] == row["unlike"] == 0
        assert len(row["worst"]) <= row["listed"] <= agreement.WORST
    rates = records(tmp_path, "rates")
    timed = [(r["name"], r["size"], r["order"], r["round"]) for r in rates if "why" not in r]
    names = ("xla", "xla, 4 vary", speed.SCAN)
    assert set(timed) >= set(itertools.product(names, (16, 32), speed.ORDERS, (0, 1)))
    engine = [r for r in rates if r.get("backend")]
    assert all(r["kernel_s"] > 0 and r["whole_s"] > 0 for r in engine)
    assert len(records(tmp_path, "memory")) == 2
    before = (tmp_path / "out" / "tables.md").read_text()
    titles = [
        line.strip("*").split(":")[0] for line in before.splitlines() if line.startswith("**")
    ]
    assert titles[0] == "The machine" and titles.count("Rates") == 2 and "Memory" in titles
    again = command(tmp_path, "--tables")
    assert again.returncode == 0 and (tmp_path / "out" / "tables.md").read_text() == before
    assert set(json.loads((tmp_path / "out" / "tables.json").read_text())) == set(PARTS)


@pytest.mark.parametrize("wrong", [(), ("--only", "speed"), ("--sizes", "0")])
def test_no_card_or_a_wrong_request_is_one_line_and_exit_2(tmp_path, wrong):
    done = command(tmp_path, *wrong)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.splitlines()[-1].startswith("python -m benchmarks.gpu: ")
    assert wrong or ("--cpu" in done.stderr and len(done.stderr.splitlines()) == 1)


def test_it_needs_no_package_of_sweeps():
    wanted = "import sys, benchmarks.gpu.__main__ as gpu; "
    code = wanted + "assert not {'sweeps', 'zarr', 'typer', 'pydantic', 'scipy'} & {*sys.modules}"
    subprocess.run([sys.executable, "-c", code], check=True)


def session(tmp_path, **changed):
    sizes = {"scenarios": 16, "steps": 4, "bits": 16, "sizes": (16,), "run_steps": 4}
    plan = {"backends": ("xla",), "dtypes": ("float32",), "integrators": ("rk4",)}
    rest = {"readings": (), "every": False, "repeats": 1, "jobs": 1}
    return Session(Plan(**{**sizes, **plan, **rest, **changed}), Results(tmp_path))


def test_without_time_each_part_says_what_it_left_out(tmp_path):
    late = session(tmp_path)
    for part in ("bits", "rates", "correctness"):
        measure, tables, _ = PARTS[part]
        measure(late)
        every = late.results.of(part)
        assert every and all(r["why"] == "no time was left" for r in every)
        assert (
            "not measured: no time was left"
            in tables(every)[-1 if part == "rates" else 0].notes[-1]
        )


def test_a_call_ends_at_the_deadline(tmp_path):
    late = session(tmp_path)
    late.deadline = monotonic() + 0.5
    with Child() as child, pytest.raises(LeftOut):
        late.ask(child, "signal.pause")
    late.deadline = monotonic() + 60
    with Child() as child, pytest.raises(BenchError, match="JSONDecodeError"):
        late.ask(child, "json.loads", s="")


def test_memory_is_what_a_sweep_adds(tmp_path, monkeypatch):
    readings = iter([[7e6, 6e6, 6e6], [6e6, 9e6, 8e6]])
    monkeypatch.setattr(memory, "memory_used", lambda: nullcontext(next(readings)))
    once = session(tmp_path)
    once.deadline = monotonic() + 300
    monkeypatch.setattr(memory, "Child", nullcontext)
    monkeypatch.setattr(memory, "IDLE", 0.0)
    monkeypatch.setattr(Session, "ask", lambda *_, **__: None)
    memory.measure(once)
    (row,) = memory.tables(once.results.of("memory"))[0].rows
    assert row["name"] == "xla" and row["peak_MB"] == 3.0


def test_every_option_is_a_reading():
    one_at_a_time = list(agreement.readings(every=False))
    assert len(one_at_a_time) == 1 + sum(
        len(v) - 1 for k, v in CHOICES.items() if k != "integrator"
    )
    assert len({str(r) for r in agreement.readings(every=True)}) == 216


def test_distances_are_in_units_of_the_last_place():
    for dtype in (np.float32, np.float64):
        step = np.spacing(dtype(1.0))
        one = np.array([1.0, 1.0, -0.0, np.nan, np.inf, np.nan, -1.0, np.inf], dtype)
        other = np.array([1.0, 1 + 3 * step, 0.0, np.nan, np.inf, 1.0, 1.0, -np.inf], dtype)
        distance = apart(one, other)
        assert list(distance[:6]) == [0, 3, 1, 0, 0, UNLIKE] and distance[7] == UNLIKE
        assert 0 < distance[6] < UNLIKE
    assert list(apart(np.int32([3, 5]), np.int32([3, 2]))) == [0, 3]
    assert list(apart(np.array([True, False]), np.array([True, True]))) == [0, 1]


def test_differences_are_counted_by_metric_and_the_worst_scenarios_are_listed():
    n, batch = 4, wide(4, seed=1)
    theirs = Metrics(**{name: np.ones(n, np.float32) for name in METRICS})
    nmse = np.float32([1.0, 1.0 + 2.0**-23, 1.0, np.nan])
    ours = Metrics(**{**vars(theirs), "nmse": nmse, "energy_in": np.float32([1, 1, 1, 1.5])})
    found = differences(ours, theirs, batch, listed=1)
    assert (found["identical"], found["unlike"], found["finite_differs"]) == (2, 1, 0)
    nmse = found["metrics"]["nmse"]
    assert (nmse["differ"], nmse["unlike"], nmse["ulps"]) == (2, 1, [1, 1, 1])
    assert nmse["relative"] == pytest.approx(2.0**-23)
    assert set(found["metrics"]) == {"nmse", "energy_in"} and found["ulps"][0] == 1
    (worst,) = found["worst"]
    assert worst["params"]["K0"] == batch.K0[3]
    assert worst["metrics"] == {"nmse": ["nan", "1.0"], "energy_in": ["1.5", "1.0"]}
    json.dumps(found)


def test_a_later_result_replaces_an_earlier_one_and_a_cut_line_is_left_out(tmp_path):
    results = Results(tmp_path)
    results.add("rates", "a", why="no card")
    results.add("rates", "a", 0, whole_s=2.0)
    results.add("rates", "a", 0, whole_s=1.0)
    results.begin("rates")
    results.add("rates", "b", why="no card")
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"part": "rates", "case": "c", "rou')
    again = Results(tmp_path).of("rates")
    assert again == results.of("rates") and again[0]["whole_s"] == 1.0
    assert missing(again) == ["b: not measured: no card"]


def test_a_kernel_is_timed_by_events_of_its_card(monkeypatch):
    """On columns that are on the card; a peer's kernel runs in a call of its own."""
    stand_in = card.install(monkeypatch, (9, 0))
    monkeypatch.setattr(speed, "import_module", lambda name: Twin)
    batch = {"n": 8, "order": "grid", "steps": 4, "name": "", "dtype": "float64"}
    speed.prepared.cache_clear()
    ours = speed.timed(**batch, backend="ptx", four=True)
    assert ours["kernel_s"] == 0.25 and ours["whole_s"] > 0
    assert len(stand_in.launches) == 4  # to compile, whole, to load the kernel, to time it
    assert speed.timed(**batch, peer="cuda")["kernel_s"] == 0.125
    speed.prepared.cache_clear()
    sweeping._program.cache_clear()


class Twin:
    """A peer with a kernel."""

    @staticmethod
    def prepare(batch, dt, n_steps):
        assert all(np.shape(leaf) == (8,) for leaf in jax.tree.leaves(batch))

        def run():
            return None

        run.kernel_seconds = lambda repeats: [0.125] * repeats
        return run


def test_fewer_scenarios_for_those_that_launch_kernels_for_each_step(tmp_path):
    plan = session(tmp_path, backends=("ptx", "pallas", "xla"), integrators=("rk4_events",)).plan
    every = {one.name: one for one in speed.contenders(plan, "float32")}
    assert every["xla, located"].most == speed.FEW_IN_BLOCKS and every["ptx"].most is None
    names = [one.name for one in speed.contenders(replace(plan, backends=("xla",)), "float64")]
    assert names == ["xla", speed.CUDA, "xla, located"]


def test_the_targets_compare_the_same_rounds(tmp_path):
    results = Results(tmp_path)
    seconds = {"ptx": (2e-4, 2.5e-4), speed.CUDA: (1.9e-4, 5e-4), "ptx, located": (2.8e-4, 4e-4)}
    for name, (kernel, whole) in seconds.items():
        about = {"name": name, "dtype": "float32", "order": "random", "steps": 1000, "size": 10_000}
        backend = None if name == speed.CUDA else "ptx"
        for i in range(3):
            results.add("rates", name, i, **about, scenarios=10_000, backend=backend,
                        kernel_s=kernel * (1 + i), whole_s=whole * (1 + i))  # fmt: skip
    targets, rates = speed.tables(results.of("rates"))
    by_name = {row["name"]: row for row in targets.rows}
    assert by_name["ptx's kernel rate over the CUDA twin's"]["all"] == pytest.approx(3 * [0.95])
    assert by_name["whole call's rate over the kernel's: ptx"]["median"] == pytest.approx(0.8)
    assert by_name["located switches, time over rk4's, kernel: ptx"]["met"] == "yes"
    assert by_name["ptx, kernel, 10^9 plant steps a second"]["best"] == pytest.approx(50.0)
    assert {row["name"]: row.get("kernels") for row in rates.rows}[speed.CUDA] == pytest.approx(
        0.95
    )
