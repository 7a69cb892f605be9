"""The fastest motion of a scenario, which a plant step has to resolve."""

import numpy as np

from fic_jax.params import Params


def fastest_rate(p: Params) -> float:
    """Largest |eigenvalue| (1/s) of I s^2 + D s + K = 0 over the scenarios.

    K is the environment's stiffness plus the steepest the controller gets: 2 K0 while converging
    in the linear zone, or dF/b where the profile starts to saturate (eq. 1; where dF < 0 the
    torque is cut off there and flat).
    """
    b = (np.asarray(p.xb) - p.x0) / p.S
    steepest = np.maximum(2.0 * np.asarray(p.K0), (p.Fmax - np.asarray(p.K0) * p.x0) / b)
    K, D, inertia = steepest + p.Kenv, np.asarray(p.Denv), np.asarray(p.I)
    root = np.sqrt((D**2 - 4.0 * inertia * K).astype(complex))
    return float(np.max(np.abs((D + root) / (2.0 * inertia))))
