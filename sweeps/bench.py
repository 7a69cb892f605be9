"""The engine against the plain arrangement, each in processes of its own, taken in turn."""

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import fic_jax
from fic_jax import Model, Params

DT = 0.01  # s, the paper's plant step
PEERS = ("engine", "plain")


def compare(scenarios: int, steps: int, repeats: int) -> dict[str, Any]:
    """Rates of every peer over `repeats` rounds, and the ratio of the engine to the plain one."""
    rounds = [{peer: _in_child(peer, scenarios, steps) for peer in PEERS} for _ in range(repeats)]
    rates = {peer: [r[peer]["steps_per_s"] for r in rounds] for peer in PEERS}
    ratios = [r["engine"]["steps_per_s"] / r["plain"]["steps_per_s"] for r in rounds]
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "jax": jax.__version__,
        "fic_jax": fic_jax.__version__,
        "scenarios": scenarios,
        "steps": steps,
        "repeats": repeats,
        "steps_per_s": {p: _summary(values) for p, values in rates.items()},
        "first_result_s": {p: _summary([r[p]["first_s"] for r in rounds]) for p in PEERS},
        "engine_over_plain": _summary(ratios),
    }


def table(result: dict[str, Any]) -> str:
    """The comparison as text."""
    lines = [
        "{machine}, Python {python}, jax {jax}, fic_jax {fic_jax}".format_map(result),
        f"{result['scenarios']:,} scenarios x {result['steps']:,} steps, default model, float32, "
        f"{result['repeats']} rounds in turn",
        "",
        f"{'':32}{'median':>10}{'best':>10}",
    ]
    names = {"engine": "engine, M steps/s", "plain": "plain jit(vmap(scan)), M steps/s"}
    for peer, name in names.items():
        rate = result["steps_per_s"][peer]
        lines.append(f"{name:32}{rate['median'] / 1e6:10.1f}{rate['best'] / 1e6:10.1f}")
    ratio = result["engine_over_plain"]
    lines.append(f"{'engine / plain':32}{ratio['median']:10.2f}{ratio['best']:10.2f}")
    return "\n".join(lines)


def _summary(values: list[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "best": max(values), "least": min(values)}


def _in_child(peer: str, scenarios: int, steps: int) -> dict[str, float]:
    """Flags and devices are set once a process, so each peer runs in a fresh one."""
    command = [sys.executable, "-m", "sweeps.bench", peer, str(scenarios), str(steps)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    measured: dict[str, float] = json.loads(done.stdout)
    return measured


def _scenarios(n: int) -> Params:
    """Seeded scenarios over the atlas's ranges."""
    rng = np.random.default_rng(0)
    ranges = {"K0": (1.0, 1000.0), "Kenv": (10.0, 1000.0), "Denv": (1.0, 1000.0)}
    columns = {k: np.exp(rng.uniform(np.log(a), np.log(b), n)) for k, (a, b) in ranges.items()}
    return Params(**columns, Td=rng.uniform(1.0, 20.0, n))


def _run_plain(batch: Params, steps: int) -> Callable[[], Any]:
    """What a user of the public `evaluate` would write."""
    n = len(np.asarray(batch.K0))
    columns = jax.tree.map(lambda leaf: jax.numpy.broadcast_to(jax.numpy.asarray(leaf), n), batch)
    run = jax.jit(jax.vmap(lambda p: fic_jax.evaluate(p, model=Model(), dt=DT, n_steps=steps)))
    return lambda: jax.block_until_ready(run(columns))


def _child(peer: str, scenarios: int, steps: int) -> dict[str, float]:
    if peer == "engine":
        fic_jax.tune_for_throughput()
    batch = _scenarios(scenarios)
    run = _run_plain(batch, steps)
    if peer == "engine":
        run = lambda: fic_jax.sweep(batch, dt=DT, n_steps=steps)  # noqa: E731
    seconds = []
    for _ in range(2):
        began = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - began)
    return {"first_s": seconds[0], "steps_per_s": scenarios * steps / seconds[1]}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_child(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
