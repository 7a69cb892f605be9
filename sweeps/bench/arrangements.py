"""The ways to compute the same metrics that are measured against each other.

One process runs one of them: flags and devices are read once a process.
"""

import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fic_jax
from fic_jax import Model, Params
from fic_jax.lanes import cores
from sweeps.bench.plan import DT
from sweeps.plan.grid import Grid
from sweeps.spec.reading import load

TWINS = {"cpp": "cpp", "numba": "numba_twin", "diffrax": "diffrax_twin"}
# The engine's own: what `sweep` is asked for.
ENGINE: dict[str, dict[str, Any]] = {
    "engine": {},
    "one": {},  # on one device
    "xla": {"backend": "xla"},
    "float64": {},
    "events": {"model": Model(integrator="rk4_events")},
    "estimate": {"error_estimate": True},
}


class Missing(Exception):  # noqa: N818  what is missing is no error of the program
    """Why an arrangement can't be measured here, in one line."""


def configure(kind: str) -> None:
    """Set JAX up as a user of this arrangement would; before JAX starts."""
    jax.config.update("jax_enable_x64", kind == "float64")
    if kind in ENGINE:
        fic_jax.tune_for_throughput(1 if kind == "one" else None)
    else:
        os.environ.pop("XLA_FLAGS", None)


def scenarios(n: int) -> Params:
    """Seeded scenarios over the atlas's ranges."""
    rng = np.random.default_rng(0)
    ranges = {"K0": (1.0, 1000.0), "Kenv": (10.0, 1000.0), "Denv": (1.0, 1000.0)}
    columns = {k: np.exp(rng.uniform(np.log(a), np.log(b), n)) for k, (a, b) in ranges.items()}
    return Params(**columns, Td=rng.uniform(1.0, 20.0, n))


def planned(file: Path) -> Params:
    """Every scenario of a sweep file."""
    grid = Grid(load(file))
    return grid.params(tuple(slice(0, n) for n in grid.shape))


def in_precision(batch: Params, kind: str) -> Params:
    """The batch in the precision of an arrangement."""
    dtype = np.float64 if kind == "float64" else np.float32
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype), batch)


def prepare(kind: str, batch: Params, steps: int) -> Callable[[], Any]:
    """What computes the metrics of a batch each time it is called. Raises Missing."""
    if kind in ENGINE:
        return lambda: fic_jax.sweep(batch, dt=DT, n_steps=steps, **ENGINE[kind])
    if kind == "plain":
        return _plain(batch, steps)
    try:
        peers = import_module("benchmarks.peers")
    except ImportError:
        raise Missing("not found: it comes with the source checkout") from None
    try:
        twin = import_module(f"benchmarks.peers.{TWINS[kind]}")  # it may miss something already
        return twin.prepare(batch, DT, steps, threads=cores())
    except peers.Missing as error:
        raise Missing(str(error)) from None


def _plain(batch: Params, steps: int) -> Callable[[], Any]:
    """What a user of the public `evaluate` would write."""
    n = max(np.size(leaf) for leaf in jax.tree.leaves(batch))
    columns = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), n), batch)
    run = jax.jit(jax.vmap(lambda p: fic_jax.evaluate(p, model=Model(), dt=DT, n_steps=steps)))
    return lambda: jax.block_until_ready(run(columns))
