"""The fastest rate of the closed loop, which limits the plant step (RK4: rate * dt < 2.8)."""

import numpy as np

from fic_jax.params import Params


def fastest_rate(p: Params) -> float:
    """Largest |eigenvalue| (1/s) of I s^2 + D s + K = 0 over the scenarios.

    K is Kenv plus the largest stiffness of the controller: 2 K0, converging in the linear zone, or
    dF/b, at |e| = x0 on the curve of eq. 1 (dF < 0: the torque is limited to Fmax, hence constant).
    """
    b = (np.asarray(p.xb) - p.x0) / p.S
    steepest = np.maximum(2.0 * np.asarray(p.K0), (p.Fmax - np.asarray(p.K0) * p.x0) / b)
    K, D, inertia = steepest + p.Kenv, np.asarray(p.Denv), np.asarray(p.I)
    root = np.sqrt((D**2 - 4.0 * inertia * K).astype(complex))
    return float(np.max(np.abs((D + root) / (2.0 * inertia))))
