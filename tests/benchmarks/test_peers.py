"""The peers compute the same metrics as the engine; otherwise their rates would mean nothing."""

from functools import lru_cache
from importlib import import_module

import jax
import numpy as np
import pytest

import fic_jax
from benchmarks.child import Missing
from benchmarks.implementations import scenarios
from benchmarks.plan import DT
from fic_jax import METRICS, Metrics, Params

STEPS, N = 300, 512
# Parameters that the seeded scenarios leave at their defaults.
SPECIAL = (
    Params(period=3 * DT),
    Params(Td=-5.0, gap=-0.01, xd=0.001),
    Params(gap=0.5, xd=0.6),
    Params(K0=1000.0),
    Params(x_init=-0.3, v_init=1.0, S=200.0),
)
PEERS = {
    "cpp": "benchmarks.peers.cpp",
    "cuda": "benchmarks.peers.cuda",
    "cuda_on_cpu": "tests.benchmarks.cuda_on_cpu",
    "numba_twin": "benchmarks.peers.numba_twin",
    "diffrax_twin": "benchmarks.peers.diffrax_twin",
}


def _batch(dtype: type) -> Params:
    """The special scenarios, one that overflows, then N seeded ones."""
    overflowing = Params(v_init=float(np.finfo(dtype).max) / 4)

    def column(*leaves: float | np.ndarray) -> np.ndarray:
        return np.concatenate([*map(np.atleast_1d, leaves[:-1]), np.broadcast_to(leaves[-1], N)])

    return jax.tree.map(
        lambda *leaves: column(*leaves).astype(dtype), *SPECIAL, overflowing, scenarios(N)
    )


@lru_cache
def _expected(dtype: type) -> Metrics:
    return fic_jax.sweep(_batch(dtype), dt=DT, n_steps=STEPS)


def _difference(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Relative difference; equal infinities and NaN agree."""
    ours, theirs = ours.astype(float), theirs.astype(float)
    same = (ours == theirs) | (np.isnan(ours) & np.isnan(theirs))
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.abs(ours - theirs) / np.maximum(np.abs(ours), 1e-30)
    return np.where(same, 0.0, np.where(np.isfinite(apart), apart, np.inf))


@lru_cache
def _got(peer: str, dtype: type) -> Metrics:
    return _run(peer, _batch(dtype))


def _run(peer: str, batch: Params) -> Metrics:
    try:
        run = import_module(PEERS[peer]).prepare(batch, DT, STEPS)
    except Missing as reason:
        pytest.skip(str(reason))
    return run()


# Peers round differently (reciprocals, FMA contraction, another exponential). A motion that settles
# forgets a rounding error: the median is some units of the last place (1e-16, 6e-8). A motion that
# grazes a switch amplifies it, and a few take another branch: the second bound is for 95 of 100.
BOUNDS = {np.float64: (1e-13, 1e-9), np.float32: (3e-6, 1e-3)}  # median, 95 of 100


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("peer", PEERS)
def test_a_peer_agrees_with_the_engine(peer: str, dtype: type) -> None:
    expected, got = _expected(dtype), _got(peer, dtype)
    median, most = BOUNDS[dtype]
    for name in METRICS:
        ours, theirs = getattr(expected, name), getattr(got, name)
        assert theirs.dtype == ours.dtype, name
        apart = _difference(ours, theirs)
        assert np.median(apart) <= median, name
        assert np.quantile(apart, 0.95) <= most, name
    assert not expected.finite[len(SPECIAL)] and expected.finite.sum() == len(expected.finite) - 1
    assert np.array_equal(expected.finite, got.finite)


@pytest.mark.parametrize("peer", PEERS)
def test_the_special_scenarios_agree_one_by_one(peer: str) -> None:
    expected, got = _expected(np.float64), _got(peer, np.float64)
    special = len(SPECIAL)
    for name in METRICS:
        apart = _difference(getattr(expected, name)[:special], getattr(got, name)[:special])
        assert apart.max() <= 1e-9, (name, apart)


@pytest.mark.parametrize("peer", ["cuda", "cuda_on_cpu"])
def test_the_cuda_twin_takes_a_scalar_for_a_column(peer: str) -> None:
    batch = jax.tree.map(np.float32, scenarios(N))
    assert np.ndim(batch.Fmax) == 0
    whole, got = _got(peer, np.float32), _run(peer, batch)
    for name in METRICS:
        assert np.array_equal(getattr(whole, name)[-N:], getattr(got, name)), name
