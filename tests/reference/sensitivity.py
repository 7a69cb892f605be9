"""The sensitivity of a scenario: only where it is small does a discretisation follow events.

`sensitivity` is about the motion x(t) as a whole, `conditions` about each metric.
"""

from math import inf

import numpy as np

from .events import Irregular, simulate
from .laws import Choices, Params
from .motion import METRICS, measured, metrics
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


CHANGED = ("K0", "Kenv", "I", "Td")
"""The parameters that `conditions` changes, one by one: K0 alone misses some coins."""
SMALL_CHANGE = 1e-6
"""Their relative change: above the error of `motion.metrics`, below that of a plant step."""
MOST_CONDITION = 100.0
"""A metric that moves more than this many times the change of a parameter hangs on a coin."""
FLOORS = {"nmse": 1e-12, "nmse_tail": 1e-12, "energy_in": 1e-6, "peak_torque": 1e-12}
"""Metrics with a relative error, and the size below which it is absolute (model.md)."""
TIMES = ("convergence_time", "contact_time", "contact_lost")


def conditions(
    p: Params,
    choices: Choices,
    t_end: float,
    tail_from: float | None = None,
    change: float = SMALL_CHANGE,
) -> dict[str, float]:
    """How far each metric of motion.py moves per relative change of a parameter; inf if Irregular.

    The largest over K0, Kenv, I and Td, each changed by ±change on its own. A finite change: a
    decision that goes the other way within it (a tick on the other side of a switch, a grazing
    contact) shows as a large number. `distance` says in what unit. inf where a time appears or
    vanishes and where mode_switches changes, and for mode_switches also where the motion came to
    rest at x_h: there rounding decides on the branch.
    """
    try:
        meter = measured(p, choices, t_end, tail_from)
        changed = [
            metrics(p | {name: p[name] * (1.0 + sign * change)}, choices, t_end, tail_from)
            for name in CHANGED
            for sign in (1.0, -1.0)
        ]
    except Irregular:
        return dict.fromkeys(METRICS, inf)
    base = meter.result()
    result = {}
    for name in METRICS:
        moves = [distance(name, base[name], other[name], t_end) for other in changed]
        result[name] = max(moves) / change
    if meter.came_to_rest:
        result["mode_switches"] = inf
    return result


def distance(name: str, one: float, other: float, t_end: float) -> float:
    """The difference of two values of a metric, `one` being the exact one.

    Means of squares, peak and energy: relative; overshoot: of the largest torque 1 + overshoot;
    steady_error: in parts of T_n; times: of t_end; mode_switches: inf unless the same.
    """
    if one == other:
        return 0.0
    if name == "mode_switches":
        return inf
    if name in FLOORS:
        return abs(one - other) / max(abs(one), FLOORS[name])
    if name in TIMES:
        return abs(one - other) / t_end
    return abs(one - other) / (1.0 + one if name == "overshoot" else 1.0)


def regular_metrics(
    p: Params,
    choices: Choices,
    t_end: float,
    tail_from: float | None = None,
    most: float = MOST_CONDITION,
    change: float = SMALL_CHANGE,
) -> dict[str, bool]:
    """Whether each metric depends smoothly on the parameters: its condition is at most `most`.

    A solver that errs by more than `change` still meets coins that this does not see: there are
    scenarios with a switch 2e-4 s from a tick. A change of the order of its error finds them.
    """
    found = conditions(p, choices, t_end, tail_from, change)
    return {name: condition <= most for name, condition in found.items()}
