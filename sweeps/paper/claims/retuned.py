"""C15: the stiffness changed while the controller runs."""

from functools import lru_cache

import numpy as np
import pandas as pd

from fic_jax import Model, Params
from sweeps.paper.claims.superposed import SEED, autonomous, log_uniform, with_trust
from sweeps.paper.scenarios import Reading
from sweeps.paper.superposition import DT, bodies, gains, simulate

RATIOS = (1.5, 2.0, 2.9, 3.2, 4.0, 10.0)  # of the stiffnesses alternated between
SECONDS = 40.0
TIMES = np.arange(round(SECONDS / DT)) * DT  # s
RELEASE = 0.02  # rad, where the joint is released
LAST = 50  # slices of a history: its last quarter
BEATS = np.geomspace(0.3, 8.0, 12)  # s


def schedules(reading: Reading) -> pd.DataFrame:
    """One row for each schedule of K0 between 100/ratio and 100."""
    return retuned(autonomous(reading))


@lru_cache(maxsize=32)
def retuned(model: Model) -> pd.DataFrame:
    """Columns of a schedule.

    `schedule`, its kind; `ratio`; `seconds`, the moment, mean time or beat of its changes;
    `swing`, the largest |x| over what the energy of the start allows with the softest gain,
    x(0) sqrt(ratio); `extra`, the energy beyond the start's and what the changes add, over both;
    `at_end`, |x| in the last quarter over x(0).
    """
    random, rows, K0 = np.random.default_rng(SEED), [], []
    for ratio in RATIOS:
        low, high = 100.0 / ratio, 100.0
        for up, mean in zip((True, False, True, False), (0.1, 0.3, 1.0, 3.0), strict=True):
            moment = random.uniform(0.2, 5.0)
            rows.append(("once up" if up else "once down", ratio, moment))
            K0.append(np.where((moment > TIMES) == up, low, high))
            rows.append(("at random", ratio, mean))
            K0.append(_random_steps(random, low, high, mean))
        for beat in BEATS:
            rows.append(("at a beat", ratio, beat))
            K0.append(np.where(TIMES % beat < beat / 2.0, high, low))
        rows.append(("in step", ratio, round_time(high, low)))
        K0.append(in_step(high, low))
    table = pd.DataFrame(rows, columns=["schedule", "ratio", "seconds"])
    released = bodies(len(rows), x_init=np.full(len(rows), RELEASE))
    stiffness = gains(K0=np.array(K0)[..., None])

    def shares(substeps: int) -> dict[str, np.ndarray]:
        seen = simulate(stiffness, released, model, SECONDS, substeps)
        return {
            "swing": seen.swing.max(axis=1) / (RELEASE * np.sqrt(table.ratio.to_numpy())),
            "extra": (seen.energy / (seen.start[:, None] + seen.injected)).max(axis=1) - 1.0,
            "at_end": seen.swing[:, -LAST:].max(axis=1) / RELEASE,
        }

    return with_trust(table, shares(1), shares(2))


def _random_steps(random: np.random.Generator, low: float, high: float, mean: float) -> np.ndarray:
    """K0 over TIMES, drawn anew at random moments, `mean` seconds apart."""
    moments = np.cumsum(random.exponential(mean, round(3 * SECONDS / mean)))
    values = log_uniform(random, low, high, len(moments) + 1)
    return values[np.searchsorted(moments, TIMES)]


def in_step(high: float, low: float) -> np.ndarray:
    """K0 over TIMES: `high` from the peak to half of it, `low` from there to the next peak.

    In the linear zone convergence is an oscillation of rate sqrt(2 K0/I) about e_M/2, divergence
    one of sqrt(K0/I) about 0: the times are those of any energy. Each round multiplies the peak
    by sqrt((high/low - 1)/2), and by more than 1 where high > 3 low.
    """
    return np.where(TIMES % round_time(high, low) < _stiff_time(high), high, low)


def _stiff_time(high: float) -> float:
    """From the peak e_M to e_M/2, s: a quarter of the oscillation about e_M/2."""
    return float(0.5 * np.pi / np.sqrt(2.0 * high / Params().I))


def round_time(high: float, low: float) -> float:
    """From one peak to the next, s."""
    on = np.arcsin(np.sqrt(low / high)) / np.sqrt(2.0 * low / Params().I)
    return _stiff_time(high) + float(on + 0.5 * np.pi / np.sqrt(low / Params().I))
