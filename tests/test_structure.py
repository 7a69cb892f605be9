"""The house rules that code can check: import arrows, and an import without side effects."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("fic_jax", "sweeps", "figures", "benchmarks")

# module of the physics -> modules of fic_jax that it may import
ARROWS = {
    "params": set(),
    "profile": {"params", "lanes.hints"},
    "controller": {"params", "profile", "lanes.hints"},
    "exploration": {"params"},
    "environment": {"params"},
    "passivity": {"params", "profile", "controller"},
    "stiffness": {"params"},
    "rk4": {"params", "controller", "environment"},
    "events": {"params", "controller", "rk4", "lanes.hints"},
    "simulation": {"params", "controller", "exploration", "environment", "rk4", "events"},
    "metrics": {"params", "environment", "simulation", "lanes.hints"},
    "accuracy": {"params", "metrics", "simulation"},
}
HEAVY = {
    "jax",
    "numpy",
    "scipy",
    "xarray",
    "zarr",
    "pandas",
    "pydantic",
    "matplotlib",
    "fic_jax",
    "benchmarks",
}


def modules():
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            yield name.removesuffix(".__init__"), path


def imported(path, top_only=False):
    """Modules a file imports; with top_only those that importing it brings in."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module


@pytest.mark.parametrize(("name", "path"), list(modules()), ids=str)
def test_imports_follow_the_arrows(name, path):
    package = name.split(".")[0]
    ours = {m for m in imported(path) if m.split(".")[0] in PACKAGES}
    room = name.removeprefix("fic_jax.")
    if room in ARROWS:
        assert ours <= {f"fic_jax.{other}" for other in ARROWS[room]}
    elif room.startswith("lanes"):  # sealed: it could live alone
        assert all(m.startswith("fic_jax.lanes") for m in ours)
    elif package == "fic_jax":
        assert all(m.startswith("fic_jax") for m in ours)
    elif package == "sweeps":
        # Only the command line draws, and only it measures.
        more = ("figures", "benchmarks") if name.startswith("sweeps.cli") else ()
        assert all(m.split(".")[0] in ("fic_jax", "sweeps", *more) for m in ours)
    elif package == "benchmarks":
        # `python -m benchmarks` is `fic-sweep bench`; a timed process is `fic-sweep`.
        starts = name in ("benchmarks.__main__", "benchmarks.fic_sweep")
        assert starts or not any(m.startswith("sweeps.cli") for m in ours)
    else:
        # of sweeps a figure reads stores and the paper's scenarios
        allowed = ("figures", "fic_jax", "sweeps.store.opening", "sweeps.paper.scenarios")
        assert all(m.startswith(allowed) for m in ours)


def test_physics_imports_jax_and_numpy_only():
    for name, path in modules():
        if name.startswith("fic_jax"):
            allowed = {"jax", "numpy", "fic_jax"}
            if name.startswith("fic_jax.lanes"):
                allowed.add("llvmlite")
            if name == "fic_jax.engine.histories":
                allowed.add("xarray")  # late; its result is labelled
            roots = {m.split(".")[0] for m in imported(path)}
            assert roots - sys.stdlib_module_names <= allowed, name


def test_the_command_line_imports_late():
    """`fic-sweep --help` in a quarter of a second: nothing heavy at the top of cli.py."""
    command = ROOT / "sweeps" / "cli" / "__init__.py"
    top = {m.split(".")[0] for m in imported(command, top_only=True)}
    assert not top & HEAVY


def test_only_the_command_line_prints():
    for name, path in modules():
        calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
        prints = [c for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"]
        assert not prints or name.startswith("sweeps.cli")


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
