"""Imports follow the arrows, and importing fic_jax has no side effect."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("fic_jax", "sweeps", "figures", "benchmarks")

# module of the physics -> modules of fic_jax that it may import
ARROWS = {
    "inputs": set(),
    "display": set(),
    "params": {"inputs", "display"},
    "profile": {"inputs", "params", "lanes.hints"},
    "controller": {"inputs", "params", "profile", "lanes.hints"},
    "exploration": {"inputs", "params"},
    "environment": {"inputs", "params"},
    "passivity": {"inputs", "params", "profile", "controller"},
    "stiffness": {"params"},
    "rk4": {"inputs", "params", "controller", "environment"},
    "piece": {"inputs", "params", "controller", "exploration", "environment", "lanes.hints"},
    "events": {"inputs", "params", "controller", "piece", "lanes.hints"},
    "simulation": {
        "inputs",
        "display",
        "params",
        "controller",
        "exploration",
        "environment",
        "rk4",
        "events",
        "lanes.hints",
    },
    "metrics": {
        "inputs",
        "display",
        "params",
        "environment",
        "piece",
        "events",
        "simulation",
        "lanes.hints",
    },
    "accuracy": {"inputs", "params", "piece", "events", "metrics", "simulation"},
}
# Rooms, each with all rooms that it may import: cli -> {paper, figures} -> runner -> {reduce,
# refine} -> store -> plan -> spec -> fic_jax. The longest name that fits a module is its room.
SPEC = {"fic_jax", "sweeps.spec"}
PLAN = {*SPEC, "sweeps.plan"}
STORE = {*PLAN, "sweeps.store", "sweeps.disk"}
REDUCE = {*STORE, "sweeps.reduce"}
REFINE = {*STORE, "sweeps.refine"}
RUNNER = {
    *REDUCE,
    *REFINE,
    "sweeps.runner",
    "sweeps.provenance",
    "sweeps.compile_cache",
    "sweeps.devices",
}
ROOMS = {
    "fic_jax": {"fic_jax"},
    "fic_jax.lanes": {"fic_jax.lanes"},  # it could be a package of its own
    "sweeps": {*RUNNER, "sweeps.stopping", "sweeps.cluster"},  # late, in `sweeps.run`
    "sweeps.spec": SPEC,
    "sweeps.plan": PLAN,
    "sweeps.store": STORE,
    "sweeps.processor": set(),
    "sweeps.disk": set(),
    "sweeps.compile_cache": {"sweeps.processor"},
    "sweeps.devices": SPEC,
    "sweeps.provenance": {*SPEC, "sweeps"},  # sweeps: where the sources are
    "sweeps.reduce": REDUCE,
    "sweeps.refine": REFINE,
    "sweeps.runner": RUNNER,
    "sweeps.stopping": RUNNER,
    "sweeps.worker": RUNNER,
    "sweeps.cluster": {*RUNNER, "sweeps.worker"},
    "sweeps.merge": {*STORE, "sweeps.provenance"},
    "sweeps.export": STORE,
    "sweeps.paper": {*RUNNER, "sweeps.paper", "sweeps"},  # sweeps: where its library is
    "sweeps.maps": {"sweeps.store"},
    "sweeps.explore": {*RUNNER, "sweeps.maps", "sweeps.explore", "figures"},
    "sweeps.share": {*RUNNER, "sweeps.maps", "sweeps.explore", "sweeps.share"},
    "figures": {*STORE, "sweeps.maps", "figures"},
    "figures.paper": {*STORE, "figures", "sweeps.paper.scenarios"},
    "benchmarks": {*RUNNER, "sweeps.processor", "benchmarks", "figures"},
    "benchmarks.__main__": {"sweeps.cli"},  # `python -m benchmarks` is `fic-sweep bench`
    "benchmarks.gpu": {"fic_jax", "benchmarks"},  # a machine with a card may have no more
    "benchmarks.fic_sweep": {"benchmarks", "sweeps.cli", "sweeps.runner"},  # times a whole process
    "sweeps.cli": {
        *RUNNER,
        "sweeps",
        "sweeps.cluster",
        "sweeps.explore",
        "sweeps.export",
        "sweeps.merge",
        "sweeps.paper",
        "sweeps.share",
        "benchmarks",
        "sweeps.cli",
        "figures",
    },
}


def modules():
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            yield name.removesuffix(".__init__"), path


MODULES = dict(modules())


def imported(path):
    """Modules that a file imports, at its top or in a function."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in MODULES else node.module


@pytest.mark.parametrize("name", MODULES)
def test_imports_follow_the_arrows(name):
    ours = {m for m in imported(MODULES[name]) if m.split(".")[0] in PACKAGES}
    physics = ARROWS.get(name.removeprefix("fic_jax."))
    if physics is not None:
        assert ours <= {f"fic_jax.{other}" for other in physics}
        return
    room = max((room for room in ROOMS if inside(name, room)), key=len)
    against = {m for m in ours if not any(inside(m, other) for other in ROOMS[room])}
    assert not against


def inside(module, room):
    return module == room or (room != "sweeps" and module.startswith(f"{room}."))


def test_physics_imports_jax_and_numpy_only():
    for name, path in MODULES.items():
        if name.startswith("fic_jax"):
            allowed = {"jax", "numpy", "fic_jax"}
            if name.startswith("fic_jax.lanes"):
                allowed.add("llvmlite")
            if name in ("fic_jax.lanes.gpu", "fic_jax.engine.sweeping"):
                allowed.add("cuda")  # late, where a GPU is to compute
            if name == "fic_jax.engine.histories":
                allowed.add("xarray")  # late; its result is labelled
            roots = {m.split(".")[0] for m in imported(path)}
            assert roots - sys.stdlib_module_names <= allowed, name


def test_import_changes_no_setting_and_starts_no_backend():
    code = """
import os, jax
before = dict(os.environ), jax.config.values.copy()
import fic_jax
assert (dict(os.environ), jax.config.values) == before
jax.config.update("jax_num_cpu_devices", 2)  # raises once a backend is up
fic_jax.tune_for_throughput(2)
assert jax.local_device_count() == 2
try:
    fic_jax.tune_for_throughput(1)
except RuntimeError as error:
    assert "before" in str(error)
else:
    raise AssertionError("tuned after JAX had started")
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_untuned_import_gives_the_same_numbers_to_rounding():
    """The fall-back: one device, no flags, x64 off."""
    code = """
import numpy as np, fic_jax
p = fic_jax.Params(K0=np.array([10.0, 100.0, 300.0]), Kenv=200.0)
print(*fic_jax.sweep(p, dt=0.01, n_steps=100).nmse)
"""
    tuned = "import fic_jax; fic_jax.tune_for_throughput(2)\n" + code
    plain, fast = (
        subprocess.run(
            [sys.executable, "-c", c], check=True, cwd=ROOT, capture_output=True, text=True
        ).stdout.split()
        for c in (code, tuned)
    )
    assert [float(v) for v in plain] == pytest.approx([float(v) for v in fast], rel=1e-5)


def test_the_architecture_page_names_what_exists():
    """Each row of "I want to change": the file, the functions in it, the test files."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (?!…|---)(.*?) \| (.*?) \| (.*?) \|$", page, re.MULTILINE)
    assert len(rows) > 10
    for _, place, tests in rows:
        file, *names = re.findall(r"`([^`]+)`", place)
        assert (ROOT / file).exists(), file
        code = [p.read_text() for p in (ROOT / "fic_jax").rglob("*.py")]
        code += [(ROOT / file).read_text()] if (ROOT / file).is_file() else []
        for name in (name.rpartition(".")[2] for name in names):
            assert any(re.search(rf"\b{name}\b", text) for text in code), (file, name)
        for test in re.findall(r"`(tests/[^`<]+)`", tests):
            assert (ROOT / test).exists(), test
