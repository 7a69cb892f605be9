"""Implementations of the same metrics: the engine with its options, and its peers."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import import_module
from time import perf_counter
from typing import Any

import jax
import numpy as np

import fic_jax
from benchmarks.plan import DT
from fic_jax import Model, Params
from fic_jax.lanes import cores


@dataclass(frozen=True)
class Implementation:
    """A row of the table of rates."""

    name: str
    options: dict[str, Any] = field(default_factory=dict)  # of `fic_jax.sweep`
    peer: str | None = None  # the module of benchmarks.peers to be measured instead of the engine
    dtype: str = "float32"
    share: int = 1  # a slow one gets a `share`-th of the scenarios: a rate is per scenario
    order: str = "random"  # of the scenarios, or "grid"
    baseline: str = "engine"  # whose rate is divided by this one's
    at_least: float | None = None  # target of that ratio
    at_most: float | None = None


EVENTS = Model(integrator="rk4_events")

# In the order of timing: the engine next to its closest rival, each after its baseline.
IMPLEMENTATIONS = {
    "engine": Implementation("engine"),
    "cpp": Implementation("C++ twin", peer="cpp", at_least=0.90),
    "numba": Implementation("numba twin", peer="numba_twin", at_least=2.0),
    "float64": Implementation("engine, float64", dtype="float64", share=2, at_most=1 / 0.45),
    "events": Implementation("engine, rk4_events", {"model": EVENTS}, share=2, at_most=3.0),
    "grid": Implementation("engine, grid", order="grid"),
    "grid_events": Implementation(
        "engine, rk4_events, grid",
        {"model": EVENTS},
        share=2,
        order="grid",
        baseline="grid",
        at_most=3.0,
    ),
    "xla": Implementation("engine, backend xla", {"backend": "xla"}, share=2),
    "plain": Implementation("plain jit(vmap(scan))", peer="plain", share=4, at_least=3.5),
    "diffrax": Implementation("diffrax twin", peer="diffrax_twin", share=8, at_least=8.0),
    "estimate": Implementation("engine, error_estimate", {"error_estimate": True}, share=8),
    "events_estimate": Implementation(
        "engine, rk4_events, error_estimate",
        {"model": EVENTS, "error_estimate": True},
        share=8,
        baseline="events",
    ),
}
RANGES = {"K0": (1.0, 1000.0), "Kenv": (10.0, 1000.0), "Denv": (1.0, 1000.0), "Td": (1.0, 20.0)}
LINEAR = {"Td"}  # the other ranges are logarithmic


def scenarios(n: int, order: str = "random") -> Params:
    """`n` scenarios over the ranges of the atlas, float64.

    Seeded random ones, or the product of four axes in the order in which a sweep's grid has them:
    neighbours differ in Td only, so they switch at nearly the same times.
    """
    if order == "grid":
        side = max(round(n ** (1 / 4)), 1)
        first = -(-n // side**3)
        axes = np.indices((first, side, side, side)).reshape(4, -1)[:, :n]
        parts = (axes.T / np.maximum([first - 1, side - 1, side - 1, side - 1], 1)).T
    else:
        parts = np.random.default_rng(0).uniform(size=(4, n))
    drawn = {}
    for (name, (low, high)), part in zip(RANGES.items(), parts, strict=True):
        geometric = low * (high / low) ** part
        drawn[name] = low + (high - low) * part if name in LINEAR else geometric
    return Params(**drawn)


# Called in a child, which measures one implementation only:


def first(kind: str, steps: int, n: int, devices: int | None = None) -> float:
    """Set JAX up as a user of this implementation would; seconds to compile and run it once.

    The engine uses so many devices, all by default. Raises Missing if a peer can't run here.
    """
    implementation = IMPLEMENTATIONS[kind]
    jax.config.update("jax_enable_x64", implementation.dtype == "float64")
    if implementation.peer:
        os.environ.pop("XLA_FLAGS", None)
    else:
        fic_jax.tune_for_throughput(devices)
    began = perf_counter()
    prepared(kind, steps, n)()
    return perf_counter() - began


def seconds(kind: str, steps: int, n: int) -> float:
    """Seconds of one run: `n` scenarios in memory to metrics in memory."""
    run = prepared(kind, steps, n)
    began = perf_counter()
    run()
    return perf_counter() - began


@lru_cache
def prepared(kind: str, steps: int, n: int) -> Callable[[], Any]:
    """A run of `n` scenarios. Raises Missing."""
    implementation = IMPLEMENTATIONS[kind]
    drawn = scenarios(n, implementation.order)
    batch = jax.tree.map(lambda leaf: np.asarray(leaf, implementation.dtype), drawn)
    if implementation.peer:
        peer = import_module(f"benchmarks.peers.{implementation.peer}")
        return peer.prepare(batch, DT, steps, threads=cores())
    return lambda: fic_jax.sweep(batch, dt=DT, n_steps=steps, **implementation.options)
