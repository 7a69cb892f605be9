"""Warnings about a Sweep that is allowed but may surprise."""

from collections.abc import Iterator

import numpy as np

from fic_jax.stiffness import fastest_rate
from sweeps.spec.types import Sweep

STABLE = 2.78  # |lambda| dt beyond which RK4 diverges on a linear system
ACCURATE = 1.0  # |lambda| dt up to which RK4 resolves a time constant


def warnings_of(sweep: Sweep) -> Iterator[str]:
    """A line if the force profile is not monotone, and a line if dt is too long for RK4."""
    p = sweep.extremes()
    with np.errstate(all="ignore"):  # an overflow gives inf, which still exceeds the limits
        overshoot = np.max(np.asarray(p.K0) * np.asarray(p.x0) / np.asarray(p.Fmax))
        stiffest = fastest_rate(p) * sweep.time.dt
    if overshoot > 1.0:
        yield (
            f"K0*x0 reaches {overshoot:.3g} times Fmax: there the force profile (eq. 1) is not "
            "monotone and the torque is cut off at Fmax"
        )
    if stiffest > ACCURATE:
        state = "unstable" if stiffest > STABLE else "inaccurate"
        yield (
            f"dt = {sweep.time.dt:g} s is {stiffest:.3g} times the time constant of the stiffest "
            f"scenario: RK4 is {state} there (it resolves up to {ACCURATE:g}, diverges beyond "
            f"{STABLE:g}); dt = {sweep.time.dt / stiffest:.2g} s would do"
        )
