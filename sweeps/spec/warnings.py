"""Warnings about a Sweep that is allowed but may surprise."""

from collections.abc import Iterator
from typing import cast

import numpy as np

from fic_jax.stiffness import fastest_rate
from sweeps.spec.digits import digits
from sweeps.spec.types import MAX_STEPS, Sweep

STABLE = 2.78  # |lambda| dt beyond which RK4 diverges on a linear system
ACCURATE = 1.0  # |lambda| dt up to which RK4 resolves a time constant


def warnings_of(sweep: Sweep) -> Iterator[str]:
    """A line for each: a slow controller, torques out of reach, values alike, a bent profile, dt."""
    p = sweep.extremes()
    with np.errstate(all="ignore"):  # an overflow gives inf, which still exceeds the limits
        overshoot = np.max(np.asarray(p.K0) * np.asarray(p.x0) / np.asarray(p.Fmax))
        stiffest = fastest_rate(p) * sweep.time.dt
    period, dt = sweep.held().get("period"), sweep.time.dt
    if "period" in sweep.defaults() and dt < cast(float, period):
        yield (
            f"the controller runs every {period:g} s, the default of `period`, not every dt = "
            f"{dt:g} s; `--set period={dt:g}` runs it at every plant step"
        )
    desired, limit = (np.abs(sweep.outermost(name)) for name in ("Td", "Fmax"))
    if desired.max() > limit.min():
        yield (
            f"Td reaches {desired.max():g} N*m, but the torque is limited to Fmax = "
            f"{limit.min():g} N*m: metrics compare the torque with what is reachable, "
            "sgn(Td) min(|Td|, Fmax)"
        )
    for name in sweep.axes:
        values = sweep.axis_values(name)
        short = values.astype(f"float{sweep.bits}")
        same = np.flatnonzero(short[1:] == short[:-1])
        if same.size:
            one, other = values[same[0] : same[0] + 2]
            n = digits((one, other))
            yield (
                f"{name} = {one:.{n}g} and {other:.{n}g} are one number in {sweep.bits} bits; "
                "`--precision 64` tells them apart"
            )
    if overshoot > 1.0:
        yield (
            f"K0*x0 reaches {overshoot:.3g} times Fmax: there the force profile (eq. 1) is not "
            "monotone and the torque is cut off at Fmax"
        )
    if stiffest > ACCURATE:
        state = "unstable" if stiffest > STABLE else "inaccurate"
        advice = _shorter(sweep, stiffest)
        yield (
            f"dt = {dt:g} s is {stiffest:.3g} times the time constant of the stiffest "
            f"scenario: RK4 is {state} there (it resolves up to {ACCURATE:g}, diverges beyond "
            f"{STABLE:g})" + (f"; `--set dt={advice:g}` would do" if advice else "")
        )


def _shorter(sweep: Sweep, times: float) -> float | None:
    """A plant step at least `times` shorter that divides what dt divides: periods and t_end.

    dt over a product of twos and fives is a decimal of few digits. None if the run had too many
    steps.
    """
    parts = sorted(2**i * 5**j for i in range(20) for j in range(10))
    part = next((part for part in parts if part >= times), None)
    if part is None or sweep.n_steps * part > MAX_STEPS:
        return None
    return sweep.time.dt / part
