"""Every benchmark command makes its table, at sizes too small to mean anything."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import measure, rates
from benchmarks.fic_sweep import covered
from benchmarks.implementations import IMPLEMENTATIONS, RANGES, scenarios
from benchmarks.plan import Plan
from tests.command import FIC_SWEEP, call

SMALL = ("--scenarios", "64", "--steps", "4", "--repeats", "1")
PEERS = {kind for kind, one in IMPLEMENTATIONS.items() if one.peer}


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """An environment without a C++ compiler, numba and diffrax, where XLA optimises little."""
    folder = tmp_path_factory.mktemp("bare")
    for name in ("numba", "diffrax"):
        (folder / f"{name}.py").write_text(f"raise ImportError('no {name}', name='{name}')")
    return os.environ | {
        "CXX": "g++",
        "PATH": str(folder),
        "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }


def module(name, *arguments, environment=None):
    """What `python -m` prints."""
    command = [sys.executable, "-m", name, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_python_m_benchmarks_measures_rates_and_names_each_missing_peer(bare):
    result = json.loads(module("benchmarks", *SMALL, "--json", "--only", "rates", environment=bare))
    assert result["machine"]["versions"]["c++"] is None
    table = result["tables"]["rates"]
    assert {row["kind"] for row in table["rows"]} == {*IMPLEMENTATIONS} - {
        "cpp", "numba", "diffrax"
    }  # fmt: skip
    assert all(row["million_steps_per_s"]["best"] > 0 for row in table["rows"])
    assert table["notes"] == [
        "C++ twin: not measured: g++ was not found",
        "numba twin: not measured: numba is not installed: pip install 'fic-jax[bench]'",
        "diffrax twin: not measured: diffrax is not installed: pip install 'fic-jax[bench]'",
    ]


def test_fic_sweep_bench_measures_scaling_whole_runs_and_commits(bare):
    wanted = ("scaling", "run", "first", "commit")
    only = [word for name in wanted for word in ("--only", name)]
    result = json.loads(call("bench", *SMALL, *only, "--json", code=0, environment=bare).stdout)
    assert result["settings"]["scenarios"] == 64 and result["settings"]["only"] == list(wanted)
    tables = {name: table["rows"] for name, table in result["tables"].items()}
    assert tuple(tables) == wanted
    assert [row["scenarios"] for row in tables["scaling"]] == [1, 6, 64]
    assert [row["target"] for row in tables["first"]] == ["at most 4", "at most 2", "at most 0.25"]
    _, whole, start, compiling, *_, peak, more, _ = (row["median"] for row in tables["run"])
    assert start > 0 and compiling > 0 and start + compiling < whole
    assert 50 < peak < 1500 and 50 < more < 1500  # MB
    assert "1,024 scenarios" in tables["run"][-2]["name"]
    assert [row["name"] for row in tables["commit"]] == ["wall time, s", "processor time, s"]


def test_work_precision_makes_its_table_and_figure(tmp_path):
    figure = tmp_path / "figure.png"
    arguments = ("--scenarios", "1", "--only", "Taylor, events", "--json", "--out", str(figure))
    (row,) = json.loads(module("benchmarks.work_precision", *arguments))["tables"]["precision"][
        "rows"
    ]
    assert row["method"] == "Taylor, events" and row["setting"] == "order 20"
    assert row["median"] < 1e-6 and row["microseconds"] > 0
    assert figure.read_bytes().startswith(b"\x89PNG")


class Clock:
    """In place of a Child: a run takes a microsecond per scenario; that of a peer takes two."""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def call(self, function, kind, steps, n, devices=1):
        return n * (2e-6 if kind in PEERS else 1e-6)


@pytest.mark.parametrize("peers", [True, False])
def test_rates_compare_each_implementation_with_its_baseline(monkeypatch, peers):
    monkeypatch.setattr(rates, "Child", Clock)
    table = rates.rates(Plan(scenarios=800, steps=100, peers=peers), lambda line: None)
    rows = {row["kind"]: row for row in table.rows}
    assert set(rows) == set(IMPLEMENTATIONS) - (set() if peers else PEERS)
    assert rows["engine"]["million_steps_per_s"]["median"] == pytest.approx(100.0)
    assert "baseline_over_it" not in rows["engine"]
    assert rows["events"]["baseline_over_it"]["all"] == pytest.approx(5 * [1.0])
    assert rows["events"]["scenarios"] == 400
    baselines = {kind: row["baseline"] for kind, row in rows.items() if kind != "engine"}
    assert baselines.pop("grid_events") == "engine, grid"
    assert baselines.pop("events_estimate") == "engine, rk4_events"
    assert set(baselines.values()) == {"engine"}
    if peers:
        assert rows["cpp"]["baseline_over_it"]["median"] == pytest.approx(2.0)
        assert rows["cpp"]["baseline_over_it"]["target"] == "at least 0.9"


@pytest.mark.parametrize("n", [1, 64, 1000])
def test_a_grid_has_neighbours_that_differ_in_one_axis(n):
    grid = scenarios(n, "grid")
    columns = np.stack([getattr(grid, name) for name in RANGES])
    assert columns.shape == (4, n) and len(np.unique(columns, axis=1).T) == n
    for column, (low, high) in zip(columns, RANGES.values(), strict=True):
        assert column.min() == low and (n == 1 or column.max() == pytest.approx(high))
    alike = columns[:3, 1:] == columns[:3, :-1]
    assert n == 1 or alike.all(axis=0).mean() > 0.5


def test_all_tables_unless_some_are_asked_for(monkeypatch):
    taken = []
    for name in measure.TABLES:
        take = lambda plan, say, name=name: taken.append(name)  # noqa: E731
        monkeypatch.setitem(measure.TABLES, name, take)
    monkeypatch.setattr(measure, "render", lambda *_, **__: "")
    measure.measure(Plan(), "text", print)
    assert taken == ["rates", "scaling", "run", "first", "commit"]
    taken.clear()
    measure.measure(Plan(only=("run",)), "text", print)
    assert taken == ["run"]


@pytest.mark.parametrize("wrong", [("--only", "speed"), ("--steps", "1"), ("--json", "--markdown")])
def test_a_wrong_request_is_one_line_and_exit_2(wrong):
    done = call("bench", *wrong, code=2)
    assert done.stdout == "" and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("table", "signum"), [("first", signal.SIGINT), ("commit", signal.SIGTERM)]
)
def test_an_interruption_leaves_no_file(tmp_path, table, signum):
    endless = ("bench", "--only", table, "--steps", "4", "--repeats", "1000000")
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        [FIC_SWEEP, *endless], env=environment, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr.readline().startswith(f"{table}: round 1")
        process.send_signal(signum)
        stderr = process.communicate()[1]
    assert process.returncode == 1
    assert stderr.splitlines()[-1] == "fic-sweep: interrupted"
    assert not list(tmp_path.iterdir())


def test_nested_spans_count_once():
    assert covered([(0.0, 4.0), (1.0, 2.0), (3.0, 5.0), (7.0, 8.0)]) == 6.0
    assert covered([]) == 0.0
