"""Seeded scenarios: approach, contact and welded, to measure accuracy; wide ones, for bits."""

from dataclasses import dataclass

import numpy as np

from fic_jax import Model, Params

PERIOD = 0.01  # s, control period
N_PERIODS = 1000  # 10 s


@dataclass(frozen=True)
class Kind:
    """Scenarios of one kind, `[N]` leaves, and the model that simulates them."""

    name: str
    batch: Params
    model: Model


def kinds(n: int, seed: int) -> list[Kind]:
    """`n` scenarios of each kind, every leaf float64 `[n]`.

    Approach: from rest through a gap of 0.05 to 0.5 rad; the expected wall is within 1 % of it.
    Contact: starts in contact with a hard stop. Welded: the same with a two-sided spring.
    """
    rng = np.random.default_rng(seed)
    gap = rng.uniform(0.05, 0.5, n)
    wall = {"gap": gap, "xd": gap * rng.choice([0.99, 1.0, 1.01], n)}
    hard_stop, welded = Model(), Model(contact="welded")
    return [
        Kind("approach", _drawn(rng, n, wall), hard_stop),
        Kind("contact", _drawn(rng, n, {}), hard_stop),
        Kind("welded", _drawn(rng, n, {}), welded),
    ]


def _drawn(rng: np.random.Generator, n: int, wall: dict[str, np.ndarray]) -> Params:
    """Draw what all kinds share; `wall` and the paper's values are the rest."""

    def log(low: float, high: float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), n))

    drawn = {
        "K0": log(1.0, 1000.0),
        "Kenv": log(10.0, 1000.0),
        "Denv": log(1.0, 1000.0),
        "Td": rng.uniform(1.0, 20.0, n),
        "sigma": log(0.001, 0.1),
    }
    leaves = vars(Params(**drawn, **wall, period=PERIOD))
    return Params(**{name: np.full(n, leaf, np.float64) for name, leaf in leaves.items()})


def wide(n: int, seed: int) -> Params:
    """`n` scenarios over all fields: both signs of Td, overshooting profiles, approaches.

    Every leaf is float64 `[n]`. The bits that tests/engine records are those of these draws.
    """
    rng = np.random.default_rng(seed)

    def log(low: float, high: float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), n))

    gap = np.where(rng.random(n) < 0.5, 0.0, rng.uniform(-0.1, 0.5, n))
    x0 = rng.uniform(0.05, 0.15, n)
    return Params(
        K0=log(0.5, 1000.0),
        Fmax=rng.uniform(5.0, 30.0, n),
        x0=x0,
        xb=x0 + rng.uniform(0.005, 0.05, n),
        S=rng.uniform(5.0, 30.0, n),
        Td=np.where(rng.random(n) < 0.1, -1.0, 1.0) * log(0.5, 20.0),
        xd=np.where(rng.random(n) < 0.5, gap, 0.0),
        sigma=log(0.001, 0.1),
        period=PERIOD * rng.integers(1, 6, n),
        I=log(1.0, 20.0),
        Kenv=log(10.0, 1000.0),
        Denv=np.where(rng.random(n) < 0.2, 0.0, rng.uniform(0.0, 300.0, n)),
        gap=gap,
        x_init=np.where(rng.random(n) < 0.5, 0.0, rng.uniform(-0.2, 0.2, n)),
        v_init=np.where(rng.random(n) < 0.5, 0.0, rng.uniform(-1.0, 1.0, n)),
    )
