"""`fic-sweep bench` at sizes too small to mean anything: that it measures, not what."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from sweeps.bench import tables
from sweeps.bench.plan import Plan, within
from sweeps.bench.processes import Child
from sweeps.bench.rates import PEERS
from sweeps.bench.text import as_markdown, as_text
from sweeps.bench.whole import _covered
from tests.command import FIC_SWEEP, call

SMALL = ("bench", "--scenarios", "64", "--steps", "4", "--repeats", "1")
TWINS = ("cpp", "numba", "diffrax")


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """An environment without a C++ compiler, numba and diffrax, that compiles carelessly."""
    folder = tmp_path_factory.mktemp("bare")
    for name in ("numba", "diffrax"):
        (folder / f"{name}.py").write_text(f"raise ImportError('no {name}', name='{name}')")
    return os.environ | {
        "CXX": "g++",
        "PATH": str(folder),
        "PYTHONPATH": str(folder),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }


def measured(bare):
    """Every table, asked for in two parts."""
    asked = ("--only", "rates"), ("--only", "scaling", "--only", "run", "--only", "first")
    parts = [
        json.loads(call(*SMALL, "--json", *only, code=0, environment=bare).stdout) for only in asked
    ]
    assert [len(part["tables"]) for part in parts] == [1, 3]
    return parts[0] | {"tables": parts[0]["tables"] | parts[1]["tables"]}


def test_every_table_in_every_form(bare):
    """One test, since the tables take a while and workers share nothing."""
    result = measured(bare)
    tables_are_complete(result)
    rates_name_who_is_missing(result)
    readers_get_the_same(result)


def tables_are_complete(result):
    assert set(result) == {"machine", "versions", "settings", "tables"}
    assert set(result["machine"]) == {"cpu", "architecture", "cores", "vector", "load"}
    assert {"python", "jax", "jaxlib", "numpy", "fic_jax", "c++"} <= set(result["versions"])
    assert result["versions"]["c++"] is None
    taken = result["tables"]
    assert [row["scenarios"] for row in taken["scaling"]["rows"]] == [1, 6, 64]
    assert [row["kind"] for row in taken["first"]["rows"]] == ["cold", "warm", "help"]
    run = taken["run"]
    assert run["scenarios"] == 64 and run["peak_of_more"]["scenarios"] == 16 * 64
    spent = run["start_s"]["median"] + run["compile_s"]["median"]
    assert 0 < spent < run["run_s"]["median"]
    assert 0.05e9 < run["peak_bytes"]["value"] < 1.5e9


def rates_name_who_is_missing(result):
    table = result["tables"]["rates"]
    rows = {row["kind"]: row for row in table["rows"]}
    assert set(rows) == {peer.kind for peer in PEERS} - set(TWINS)
    for kind, row in rows.items():
        assert row["steps_per_s"]["best"] >= row["steps_per_s"]["median"] > 0
        assert ("engine_over_it" in row) == (kind != "engine")
    assert rows["plain"]["target"] == {"at_least": 3.5}
    assert table["missing"] == {
        "C++ twin": "g++ was not found",
        "numba twin": "numba is not installed: pip install 'fic-jax[bench]'",
        "diffrax twin": "diffrax is not installed: pip install 'fic-jax[bench]'",
    }


def readers_get_the_same(result):
    text, markdown = as_text(result), as_markdown(result)
    for words in (
        result["machine"]["cpu"],
        "load average",
        "plain jit(vmap(scan))",
        "at least 3.5",
    ):
        assert words in text and words in markdown
    assert "C++ twin: not measured: g++ was not found" in text
    for table in markdown.split("**\n\n")[1:]:
        bars = {line.count("|") for line in table.splitlines() if line.startswith("|")}
        assert len(bars) == 1


def test_all_tables_unless_some_are_asked_for(monkeypatch):
    for name in tables.TABLES:
        monkeypatch.setitem(tables.TABLES, name, lambda plan, tell, name=name: {"is": name})
    every = tables.measure(Plan(), print)["tables"]
    assert every == {name: {"is": name} for name in ("rates", "scaling", "run", "first")}
    assert list(tables.measure(Plan(only=("run",)), print)["tables"]) == ["run"]


@pytest.mark.parametrize("wrong", [("--only", "speed"), ("--steps", "1"), ("--json", "--markdown")])
def test_a_wrong_request_is_told_in_one_line(wrong):
    done = call("bench", *wrong, code=2)
    assert done.stdout == "" and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("kind", ["cpp", "numba"])  # diffrax compiles long, and in test_peers
def test_a_twin_is_measured(kind, monkeypatch):
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    with Child(kind, 4, sizes=[8]) as child:
        if child.missing:
            pytest.skip(child.missing)
        assert child.sizes == [8] and child.seconds(8) > 0


def test_peers_come_with_the_checkout(tmp_path, monkeypatch):
    (tmp_path / "benchmarks.py").write_text("")  # somebody else's
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with Child("cpp", 4, sizes=[8]) as child:
        assert child.missing == "not found: it comes with the source checkout"


def test_children_end_with_their_parent():
    code = """
import os, signal
from sweeps.bench.processes import Child
child = Child("engine", 4, sizes=[8])
print(child._process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=False)
    assert done.returncode == -signal.SIGKILL
    _wait_for_the_end(int(done.stdout))


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_leaves_nothing(tmp_path, signum):
    command = [FIC_SWEEP, *SMALL, "--only", "first"]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr.readline().startswith("first: round 1")
        time.sleep(0.5)  # into the run that follows
        process.send_signal(signum)
        _, told = process.communicate(timeout=60)
    assert process.returncode == 1
    assert told == "fic-sweep: interrupted\n"
    assert not list(tmp_path.iterdir())


def _wait_for_the_end(pid):
    """Of a process that is not ours, which thus may stay a zombie."""
    for _ in range(300):
        state = subprocess.run(
            ["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False
        ).stdout
        if not state.strip() or state.startswith("Z"):
            return
        time.sleep(0.1)
    raise AssertionError(f"process {pid} still runs: {state}")


def test_compiling_is_counted_once():
    assert _covered([(0.0, 4.0), (1.0, 2.0), (3.0, 5.0), (7.0, 8.0)]) == 6.0
    assert _covered([]) == 0.0


def test_a_target_is_met_or_not():
    assert within(0.9, at_least=0.9) == {"target": {"at_least": 0.9}, "met": True}
    assert within(3.1, at_most=3.0)["met"] is False
    assert within(1.0) == {}
