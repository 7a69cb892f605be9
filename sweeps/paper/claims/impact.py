"""C6 to C9: the approach from 0.5 rad to five environments (fig:5, fig:8, fig:9)."""

from functools import lru_cache

import numpy as np
import pandas as pd
import xarray as xr

from sweeps.paper.scenarios import Reading, study, study_motions

SPIKE = 0.1  # s after the first touch in which a torque spike falls
SETTLED = 1.0  # s after the first touch, "a transient of about 1 s"
SWING = 0.05  # of Td: a turn of the torque counts from here


def approach(reading: Reading) -> pd.DataFrame:
    """Three stiffnesses and two further dampings of the environment."""
    return study("impact", reading)


@lru_cache(maxsize=64)
def observed(reading: Reading) -> pd.DataFrame:
    """`approach`, and what each time history shows; torques and errors over Td.

    Columns: `spike`, the largest torque within SPIKE of the touch; `turns` of the torque by more
    than SWING in the 3 s after the touch; `highest`, the largest error from SETTLED after the
    touch on; `halfway` and `last`, the mean error over the half second after 5 s and over the last
    one; `left` = last/halfway; `error`, the largest error after the touch.
    """
    table = approach(reading)
    seen = pd.DataFrame([_seen(motion) for motion in study_motions("impact", reading)])
    return table.join(seen.assign(left=seen["last"] / seen["halfway"]))


def _seen(motion: xr.Dataset) -> dict[str, float]:
    t, ratio = motion["time"].values, motion["tau_env"].values / 5.0
    since = t - t[np.argmax(motion["x"].values >= 0.5)]
    half = (t > 5.0) & (t <= 5.5)
    return {
        "spike": ratio[(since >= 0.0) & (since <= SPIKE)].max(),
        "turns": turns(ratio[(since >= 0.0) & (since <= 3.0)], SWING),
        "highest": ratio[since >= SETTLED].max(initial=-np.inf) - 1.0,
        "halfway": ratio[half].mean() - 1.0,
        "last": ratio[t > t[-1] - 0.5].mean() - 1.0,
        "error": abs(ratio[since >= 0.0] - 1.0).max(),
    }


def turns(signal: np.ndarray, swing: float) -> int:
    """How often a signal turns round, by more than `swing` each time."""
    count, low, high, rising = 0, signal[0], signal[0], None
    for value in signal:
        low, high = min(low, value), max(high, value)
        if rising is not False and value < high - swing:
            count += rising is not None
            rising, low = False, value
        elif rising is not True and value > low + swing:
            count += rising is not None
            rising, high = True, value
    return count


def damped_beside_bare(reading: Reading) -> pd.DataFrame:
    """Kenv = 100 with Denv = 0 beside Denv = 189.7 (columns `..._damped`), one row a period."""
    table = observed(reading)
    bare, damped = (table.query(f"Kenv == 100 and Denv == {d}") for d in (0.0, 189.7))
    return bare.merge(
        damped[["period", "spike", "turns"]], on="period", suffixes=("", "_damped"), sort=False
    )


def largest(reading: Reading) -> pd.DataFrame:
    """The largest nmse and the largest error of the five impacts, one row a period."""
    table = observed(reading)
    table = table.assign(error_63=table["error"].where(table["Denv"] == 63.2))
    periods = table.groupby("period", sort=False)
    columns = ["nmse", "error", "error_63"]
    return periods[columns].max().assign(least=periods["error"].min()).reset_index()
