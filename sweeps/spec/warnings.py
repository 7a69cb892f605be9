"""Warnings about a Sweep that is allowed but may surprise."""

from collections.abc import Iterator
from typing import cast

import numpy as np

from fic_jax.stiffness import fastest_rate
from sweeps.spec.digits import digits
from sweeps.spec.types import MAX_STEPS, Sweep

STABLE = 2.78  # |lambda| dt beyond which RK4 diverges on a linear system
Warned = tuple[str, str]  # what may surprise, and what `run` could do about it, or nothing
ACCURATE = 1.0  # |lambda| dt up to which RK4 resolves a time constant


def warnings_of(sweep: Sweep, advice: bool = True) -> Iterator[str]:
    """A line for each thing that may surprise; with advice, what `run` could do about it."""
    for kind in (_slow_controller, _torque_out_of_reach, _equal_values, _bent_profile, _long_step):
        for what, remedy in kind(sweep):
            yield f"{what}; {remedy}" if advice and remedy else what


def _slow_controller(sweep: Sweep) -> Iterator[Warned]:
    """`period` keeps its default where only dt was made shorter."""
    period, dt = sweep.held().get("period"), sweep.time.dt
    if "period" in sweep.defaults() and dt < cast(float, period):
        yield (
            f"the controller runs every {period:g} s, the default of `period`, not every dt = "
            f"{dt:g} s",
            f"`--set period={dt:g}` runs it at every plant step",
        )


def _torque_out_of_reach(sweep: Sweep) -> Iterator[Warned]:
    desired, limit = (np.abs(sweep.outermost(name)) for name in ("Td", "Fmax"))
    if desired.max() > limit.min():
        yield (
            f"Td reaches {desired.max():g} N*m, but the torque is limited to Fmax = "
            f"{limit.min():g} N*m: metrics compare the torque with what is reachable, "
            "sgn(Td) min(|Td|, Fmax)",
            "",
        )


def _equal_values(sweep: Sweep) -> Iterator[Warned]:
    """Neighbours on an axis that the precision of the run does not tell apart."""
    for name in sweep.axes:
        axis = sweep.axis(name)
        values = np.sort(axis) if isinstance(axis, list) else axis.closest()
        with np.errstate(over="ignore", invalid="ignore"):
            same = np.flatnonzero(np.diff(values.astype(f"float{sweep.bits}")) == 0)
        if same.size:
            one, other = values[same[0] : same[0] + 2]
            n = digits((one, other))
            yield (
                f"{name} = {one:.{n}g} and {other:.{n}g} are one number in {sweep.bits} bits",
                "`--precision 64` tells them apart",
            )


def _bent_profile(sweep: Sweep) -> Iterator[Warned]:
    p = sweep.extremes()
    with np.errstate(all="ignore"):  # an overflow gives inf, which still exceeds 1
        overshoot = np.max(np.asarray(p.K0) * np.asarray(p.x0) / np.asarray(p.Fmax))
    if overshoot > 1.0:
        yield (
            f"K0*x0 reaches {overshoot:.3g} times Fmax: there the force profile (eq. 1) is not "
            "monotone and the torque is cut off at Fmax",
            "",
        )


def _long_step(sweep: Sweep) -> Iterator[Warned]:
    dt = sweep.time.dt
    with np.errstate(all="ignore"):  # an overflow gives inf, which still exceeds the limits
        stiffest = fastest_rate(sweep.extremes()) * dt
    if stiffest > ACCURATE:
        state = "unstable" if stiffest > STABLE else "inaccurate"
        shorter = _shorter_step(sweep, stiffest)
        yield (
            f"dt = {dt:g} s is {stiffest:.3g} times the time constant of the stiffest "
            f"scenario: RK4 is {state} there (it resolves up to {ACCURATE:g}, diverges beyond "
            f"{STABLE:g})",
            f"`--set dt={shorter:g}` would do" if shorter else "",
        )


def _shorter_step(sweep: Sweep, times: float) -> float | None:
    """A plant step at least `times` shorter that divides what dt divides: periods and t_end.

    dt over a product of twos and fives is a decimal of few digits. None if the run had too many
    steps.
    """
    parts = sorted(2**i * 5**j for i in range(20) for j in range(10))
    part = next((part for part in parts if part >= times), None)
    if part is None or sweep.n_steps * part > MAX_STEPS:
        return None
    return sweep.time.dt / part
