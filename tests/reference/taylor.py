"""The motion inside one cell as a Taylor polynomial in time, and where it leaves the cell.

Off the bend the closed loop is I ẍ = const - k x - d v, on the bend ẍ also holds an exponential of
x. Both have Taylor coefficients by recurrence, so one step reaches rounding error and everything
within it (events, extrema, integrals) is a question about a polynomial.
"""

from collections.abc import Callable
from functools import partial
from math import inf

from scipy.optimize import brentq  # type: ignore[import-untyped,unused-ignore]

from .cells import Bend, Cell, Spring, State

Polynomial = list[float]
"""Coefficients in ascending powers of the time since the start of the step."""

ORDER = 20
TRUNCATION = 1e-15
"""What the last term of v (rad/s) may add within a step. A step is then about 1.5 over the loop's
fastest rate: an oscillation has at most one extremum in it."""
PROBES = 4
"""Parts of a step between which a sign change is looked for: on the bend there may be more."""


def series(s: State, cell: Cell) -> tuple[Polynomial, Polynomial]:
    """The polynomials of x (rad) and v (rad/s), from the equation of the cell."""
    piece, reaction, inertia = cell.torque, cell.reaction, cell.inertia
    stiffness, damping = reaction.Kenv / inertia, reaction.Denv / inertia
    if isinstance(piece, Spring):
        stiffness += piece.stiffness / inertia
    x, v = [s.x, s.v], [s.v, cell.acceleration(s.x, s.v)]
    if isinstance(piece, Bend):
        missing = [piece.missing(s.x)]
        rate, gain = piece.sign / piece.b, -piece.sign * piece.dF / inertia
    for n in range(1, ORDER):
        x.append(v[n] / (n + 1))
        a = -stiffness * x[n] - damping * v[n]
        if isinstance(piece, Bend):
            # d/dt exp(s x / b) = (s / b) v exp(s x / b): a product of two series.
            product = sum(missing[j] * v[n - 1 - j] for j in range(n))
            missing.append(rate * product / n)
            a += gain * missing[n]
        v.append(a / (n + 1))
    return x, v


def step_size(v: Polynomial) -> float:
    """The time in s within which the last terms of v stay below TRUNCATION; inf if they are 0."""
    sizes = [(TRUNCATION / abs(v[n])) ** (1.0 / n) for n in (ORDER - 1, ORDER) if v[n] != 0.0]
    return min(sizes, default=inf)


def value(polynomial: Polynomial, t: float) -> float:
    """The polynomial at t, by Horner's rule."""
    result = 0.0
    for coefficient in reversed(polynomial):
        result = result * t + coefficient
    return result


def derivative(polynomial: Polynomial) -> Polynomial:
    """The polynomial's rate of change per s."""
    return [n * polynomial[n] for n in range(1, len(polynomial))]


def root(function: Callable[[float], float], low: float, high: float) -> float:
    """Where the function changes sign between low and high, to rounding."""
    return float(brentq(function, low, high, xtol=1e-17, rtol=1e-15, maxiter=200))


def crossing(polynomial: Polynomial, level: float, low: float, high: float) -> float:
    """When the polynomial passes the level; the two ends lie on its two sides or on it."""
    return root(lambda t: value(polynomial, t) - level, low, high)


def sign_changes(polynomial: Polynomial, h: float) -> list[float]:
    """The times in (0, h) at which the polynomial changes sign, ascending."""
    times = [h * i / PROBES for i in range(PROBES + 1)]
    values = [value(polynomial, t) for t in times]
    at = partial(value, polynomial)
    return [
        root(at, times[i], times[i + 1])
        for i in range(PROBES)
        if values[i] * values[i + 1] < 0.0 or (values[i + 1] == 0.0 and i + 1 < PROBES)
    ]


def first_exit(x: Polynomial, v: Polynomial, cell: Cell, h: float) -> tuple[float, str | None]:
    """The time in s of the step's end, or of the line it leaves the cell by: "x" or "v".

    v runs one way between the zeros of its derivative, and x runs one way until v leaves.
    """
    end, name = h, None
    marks = [0.0, *sign_changes(derivative(v), h), h]
    speeds = [value(v, t) for t in marks]
    for i in range(len(marks) - 1):
        before, after = speeds[i], speeds[i + 1]
        if after < before and after <= cell.v_low:
            line = cell.v_low
        elif after > before and after >= cell.v_high:
            line = cell.v_high
        else:
            continue
        end, name = crossing(v, line, marks[i], marks[i + 1]), "v"
        break
    if abs(cell.x_next) < inf and (value(x, end) - cell.x_next) * cell.heading >= 0.0:
        return crossing(x, cell.x_next, 0.0, end), "x"
    return end, name
