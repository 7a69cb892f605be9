"""The sensitivity of a scenario: only where it is small does a discretisation follow events."""

from math import inf

import numpy as np

from .events import Irregular, simulate
from .laws import Choices, Params
from .scenarios import random_scenarios

CHANGE = 3e-3
"""Relative change of I, Kenv and Td that stands for the error of a plant step of some ms."""
LEAST_SCALE = 0.01
"""Motions smaller than this (rad) are compared against it instead of their own range."""


def scale(x: np.ndarray) -> float:
    """The range of the motion in rad that an error of x is measured against."""
    return max(float(np.ptp(x)), LEAST_SCALE)


def sensitivity(p: Params, choices: Choices, t_end: float) -> float:
    """Largest relative change of x(t) per relative change of the parameters; inf if Irregular.

    A finite change, so that a decision which nearly went the other way (a grazing contact, a
    tick near |x| = |xd|) shows as a large number. Settled motions give about 1.
    """
    times = np.arange(1, 51) * (t_end / 50.0)
    try:
        x = simulate(p, choices, t_end, times)["x"]
        changes = []
        for change in (CHANGE, -CHANGE):
            q = p | {name: p[name] * (1.0 + change) for name in ("I", "Kenv")}
            q["Td"] = p["Td"] * (1.0 + 0.5 * change)
            changes.append(np.max(np.abs(simulate(q, choices, t_end, times)["x"] - x)))
    except Irregular:
        return inf
    return float(max(changes)) / CHANGE / scale(x)


def regular_scenarios(
    n: int, seed: int, t_end: float, dt: float, most: float = 10.0
) -> list[tuple[Params, Choices]]:
    """Those of n random scenarios where steps of dt (s) should follow the events closely.

    Left out: `Irregular` ones, sensitivity above `most`, and `error_rate` where some jump of x_h
    does not clearly outweigh the motion of one step (margin below 4 dt).
    """
    regular = []
    for p, choices in random_scenarios(n, seed):
        if sensitivity(p, choices, t_end) > most:
            continue
        if simulate(p, choices, t_end)["margins"].min(initial=inf) > 4.0 * dt:
            regular.append((p, choices))
    return regular
