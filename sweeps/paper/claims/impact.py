"""C6 to C9: the approach from 0.5 rad to five environments (fig:5, fig:8, fig:9)."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from fic_jax import QUANTITIES, Model, Params
from fic_jax.environment import interaction_torque
from fic_jax.params import canonical
from sweeps.paper.logs import Floats, Log, average
from sweeps.paper.scenarios import Reading, study, study_logs

SPIKE = 0.1  # s after the first touch in which a torque spike falls
SETTLED = 1.0  # s after the first touch, "a transient of about 1 s"
SWING = 0.05  # of Td: a turn of the torque counts from here
Td, GAP = 5.0, 0.5  # N*m, rad: of all five
# By what a quantity may change with the rounding of the parameters, and still be trusted: a part of
# itself, and of Td.
SAME = 0.01
SEEN = ("spike", "turns", "highest", "halfway", "last", "left", "error")


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

    Where the motion is resolved, `spike` and `error` hold the torque at the touch itself, which no
    sample shows: a damper's torque is highest there.
    """
    table = approach(reading)
    at_touch = _touch_torque if reading.resolved else _nothing
    own: list[dict[str, float]] = []
    twins: list[dict[str, float]] = []
    rows = (row for _, row in table.iterrows())
    for row, pair in zip(rows, study_logs("impact", reading), strict=True):
        for found, run in zip((own, twins), pair, strict=True):
            found.append(_seen(run, at_touch(row, run, reading.model)))
    seen, twin = pd.DataFrame(own), pd.DataFrame(twins)
    known = {f"{name}_trusted": _same(seen[name], twin[name]) for name in SEEN}
    return table.join(seen.assign(**known))


def _same(one: pd.Series, other: pd.Series) -> pd.Series:
    return (one == other) | (abs(one - other) <= SAME * abs(one).clip(lower=0.1))


def _seen(run: Log, touch: float) -> dict[str, float]:
    """What one run shows; `touch` is the torque at the touch over Td, -inf if it is not known."""
    t, ratio = run.t, run.tau_env / Td
    reached = run.x >= GAP
    since = np.where(reached.any(), t - t[np.argmax(reached)], -np.inf)
    after = since >= 0.0
    halfway = average(t, ratio, 5.0, "time", 5.5) - 1.0
    last = average(t, ratio, t[-1] - 0.5, "time", t[-1]) - 1.0
    return {
        "spike": max(ratio[after & (since <= SPIKE)].max(initial=-np.inf), touch),
        "turns": turns(ratio[after & (since <= 3.0)], SWING),
        "highest": ratio[since >= SETTLED].max(initial=-np.inf) - 1.0,
        "halfway": halfway,
        "last": last,
        "left": last / halfway,
        "error": max(abs(ratio[after] - 1.0).max(initial=-np.inf), touch - 1.0),
    }


def _nothing(row: pd.Series, run: Log, model: Model) -> float:
    return -np.inf


def _touch_torque(row: pd.Series, run: Log, model: Model) -> float:
    """The torque at the first touch, over Td, from the speed there.

    Before it the joint is free: v^2 is extended along x from the last two samples.
    """
    i = int(np.argmax(run.x >= GAP))
    if not i:
        return -np.inf
    (x0, x1), (v0, v1) = run.x[i - 2 : i], run.v[i - 2 : i]
    square = v1**2 + (v1**2 - v0**2) / (x1 - x0) * (GAP - x1)
    with jax.enable_x64(True):
        p = canonical(Params(**{name: float(row[name]) for name in QUANTITIES}))
        torque = interaction_torque(p.gap, jnp.sqrt(square), p, model)
    return float(torque) / Td


def turns(signal: Floats, swing: float) -> int:
    """How often a signal turns round, by more than `swing` each time."""
    if not signal.size:
        return 0
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
    columns = ["spike", "turns"]
    names = {name: f"{name}_damped" for name in columns}
    names |= {f"{name}_trusted": f"{name}_damped_trusted" for name in columns}
    return bare.merge(damped[["period", *names]].rename(columns=names), on="period", sort=False)


def largest(reading: Reading) -> pd.DataFrame:
    """The largest nmse and the largest error of the five impacts, one row a period."""
    table = observed(reading)
    table = table.assign(error_63=table["error"].where(table["Denv"] == 63.2))
    periods = table.groupby("period", sort=False)
    columns = ["nmse", "error", "error_63"]
    known = periods[["nmse_trusted", "error_trusted"]].all()
    ends = periods[columns].max().assign(least=periods["error"].min())
    return ends.join(known).reset_index()
