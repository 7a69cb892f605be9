"""Closed forms for the loop of Algorithms 1 and 2, each a limit of `loop` that a hand can evaluate.

Notation: g = sigma/(period K0), gain of Algorithm 2 per second; e_M = Td/K0, the error the joint
starts at; r = F_K(e_M)/Td, its torque over the desired one; K = 2 F_K(e_M)/e_M, its slope.
"""

from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from fic_jax import Params
from sweeps.paper.loop import Floats, first_branch


def gain(p: Params) -> Floats:
    """g = sigma/(period K0), 1/(N*m*s): by how much a torque error moves the reference a second."""
    return np.asarray(np.asarray(p.sigma) / (np.asarray(p.period) * np.asarray(p.K0)))


def time_constant(p: Params) -> Floats:
    """How slowly the torque error fades, s, the inertia neglected: the slow root of the loop.

        Denv s^2 - (Kenv + K + g K Denv) s + g K Kenv = 0,  1/s

    For a fast search it is Denv/Kenv; a slow one adds (1/K + 1/Kenv)/g.
    """
    _, K, _ = first_branch(p)
    Kenv, Denv, g = np.asarray(p.Kenv), np.asarray(p.Denv), gain(p)
    sum_, product = Kenv + K + g * K * Denv, g * K * Kenv
    # the larger root first: the smaller one is then no difference of near numbers
    return np.asarray((sum_ + np.sqrt(sum_**2 - 4.0 * Denv * product)) / (2.0 * product))


def fast_tail(p: Params, t_end: float) -> Floats:
    """nmse_tail of a fast search: eps(t) = -exp(-t Kenv/Denv)/(g Denv), of sigma/(period K0) alone.

    The joint still moves while the environment yields, and the reference lags behind it by what
    moves it.
    """
    Kenv, Denv = np.asarray(p.Kenv), np.asarray(p.Denv)
    decay = np.exp(-t_end * Kenv / Denv)
    mean = Denv / (t_end * Kenv) * decay * (1.0 - decay)
    return np.asarray(mean / (gain(p) * Denv) ** 2)


def gain_for(tail: float, p: Params, t_end: float) -> float:
    """g that gives a fast search this nmse_tail: the line sigma/(period K0) = const."""
    return float(np.ravel(gain(p) * np.sqrt(fast_tail(p, t_end) / tail))[0])


def overshoot_stiffness(p: Params) -> Floats:
    """K0 below which the joint overshoots its rest and turns, N*m/rad; where r = 1 no joint turns.

        K0 < (r - 1)/(2 r) (Kenv - 2 sigma Denv/period)

    It starts with r times the desired torque. With the inertia neglected its position overshoots
    if r Td/Denv, the first velocity, exceeds the fast root of the loop times Td/Kenv. Turning, it
    latches a new e_M and the torque jumps back up: a limit cycle, unless e_M gets below x0.
    """
    r, _, _ = first_branch(p)
    free = np.asarray(p.Kenv) - 2.0 * np.asarray(p.sigma) * np.asarray(p.Denv) / p.period
    return np.asarray((r - 1.0) / (2.0 * r) * free)


def stripe(p: Params) -> tuple[float, float]:
    """K0 between which Algorithm 1 as printed has no rest while converging, N*m/rad.

    At rest slope (e - e_M/2) = Td. Beyond x0 the slope is 2 F_K(e_M)/e_M and that e is below x0;
    below x0 it is 4 E_K(e_M)/e_M^2 and that e is beyond: the torque jumps to and fro at |e| = x0.
    """

    def rest(K0: float, slope_of: int) -> float:
        slope = first_branch(replace(p, K0=K0))[slope_of][0]
        return float(0.5 * p.Td / K0 + p.Td / slope - p.x0)

    low, high = 0.5 * p.Td / p.x0, p.Td / p.xb
    return brentq(rest, low, high, args=(1,)), brentq(rest, low, high, args=(2,))


def search_resolution(p: Params) -> Floats:
    """A sigma that suits the environment, for errors that start in the linear zone (r = 1).

        sigma = min(0.4, max(period Denv/I, 0.1 period w (1 + 2 K0/Kenv))),  w^2 = (Kenv + 2 K0)/I

    Shape from the loop: where damping rules, T follows the reference like an integrator of gain
    2 K0 g with the lag I/Denv, and 2 K0 g is set to twice 1/lag. Where stiffness rules the gain is
    g 2 K0 Kenv/(2 K0 + Kenv) and is set to a fifth of the natural frequency w. At last, a tick may
    make good 0.8 of the error. The three numbers are fitted to the sweep `search-resolution`.
    """
    K, Kenv = 2.0 * np.asarray(p.K0), np.asarray(p.Kenv)
    natural = 0.1 * p.period * np.sqrt((Kenv + K) / p.I) * (1.0 + K / Kenv)
    damped = p.period * np.asarray(p.Denv) / p.I
    return np.asarray(np.minimum(0.4, np.maximum(damped, natural)))
