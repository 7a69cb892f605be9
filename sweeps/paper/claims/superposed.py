"""C14: random pairs and triples of controllers on one inertia, free and against a stop."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pandas as pd

from fic_jax import Model
from sweeps.paper.scenarios import Reading
from sweeps.paper.superposition import bodies, gains, simulate

SEED = 2020
DRAWS = 256
# What half the step may change: a part of a share, or of 1. It is what a claim allows.
SAME = 0.01


def autonomous(reading: Reading) -> Model:
    """What of a reading matters where no reference searches and the stop is a hard one."""
    model = reading.model
    return Model(law=model.law, divergence=model.divergence, peak=model.peak)


def draws(reading: Reading) -> pd.DataFrame:
    """One row for each draw; `..._older` is of the same draw with the older law."""
    model = autonomous(reading)
    older = superposed(replace(model, law="energy"), trust=False)
    return superposed(model).assign(gained_older=older.gained, moving_older=older.moving)


@lru_cache(maxsize=32)
def superposed(model: Model, trust: bool = True) -> pd.DataFrame:
    """Columns of a draw.

    `controllers`; `references`, "one" or "apart"; `stop`; `stiffening`, the largest Fmax/(K0 xb) of
    its controllers; `gained`, the largest energy over that at the start, less 1; `moving`, the
    kinetic energy left after 20 s, over that at the start.
    """
    n, random = DRAWS, np.random.default_rng(SEED)
    shape, i = (n, 1, 3), np.arange(n)
    three, apart, stop = i % 2 == 1, i // 2 % 2 == 1, i // 4 % 2 == 1
    silent = ~three[:, None, None] & (np.arange(3) == 2)
    x0, K0 = random.uniform(0.03, 0.15, shape), log_uniform(random, 5.0, 300.0, shape)
    xb = x0 + random.uniform(0.005, 0.05, shape)
    # from a spring that only softens to one that stiffens twenty times between x0 and xb
    stiffest = log_uniform(random, 1.0, 20.0, n)[:, None, None]
    Fmax = np.maximum(K0 * xb * (0.9 + random.random(shape) * (stiffest - 0.9)), K0 * x0)
    xd = np.where(apart[:, None, None], random.uniform(-0.1, 0.1, shape), 0.0)
    controllers = gains(
        K0=np.where(silent, 1e-6, K0), Fmax=np.where(silent, 1e-6, Fmax), x0=x0, xb=xb, xd=xd
    )
    body = bodies(
        n,
        I=log_uniform(random, 1.0, 20.0, n),
        x_init=random.uniform(-0.3, 0.3, n),
        Kenv=np.where(stop, log_uniform(random, 20.0, 500.0, n), 0.0),
        Denv=np.where(stop, random.uniform(0.0, 200.0, n), 0.0),
        gap=random.uniform(-0.1, 0.3, n),
    )
    table = pd.DataFrame(
        {
            "draw": i,
            "controllers": np.where(three, 3, 2),
            "references": np.where(apart, "apart", "one"),
            "stop": stop,
            "stiffening": np.where(silent, 0.0, Fmax / (K0 * xb)).max(axis=(1, 2)),
        }
    )

    def shares(substeps: int) -> dict[str, np.ndarray]:
        seen = simulate(controllers, body, model, 20.0, substeps)
        return {
            "gained": seen.energy.max(axis=1) / seen.start - 1.0,
            "moving": seen.kinetic[:, -10:].max(axis=1) / seen.start,
        }

    return with_trust(table, shares(1), shares(2)) if trust else table.assign(**shares(1))


def with_trust(
    table: pd.DataFrame, seen: Mapping[str, np.ndarray], finer: Mapping[str, np.ndarray]
) -> pd.DataFrame:
    """The table with what was seen; a share is trusted if half the step changes it by less
    than SAME."""
    known = {
        f"{name}_trusted": abs(seen[name] - finer[name]) <= SAME * np.maximum(seen[name], 1.0)
        for name in seen
    }
    return table.assign(**seen, **known)


def log_uniform(
    random: np.random.Generator, low: float, high: float, shape: int | tuple[int, ...]
) -> np.ndarray:
    """Random numbers, even on a log scale."""
    return np.asarray(np.exp(random.uniform(np.log(low), np.log(high), shape)))
