"""The exact metrics of the event-driven solution: those of the motion, not of samples of it.

events.py decides which law holds when; here the motion inside each of its cells is a Taylor
polynomial (taylor.py). Integrals over time are integrals of that polynomial, the work of the
torque is a difference of its potential, extrema and crossings of the 5 % band are its roots. So
every metric carries rounding and truncation only, about 1e-12; with scipy's DOP853 in place of
the polynomials the same motion comes out to 1e-8 (test_reference.py).
"""

from math import inf

import numpy as np

from .cells import Cell, State
from .events import run
from .laws import BAND, LEAST_STAY, Choices, Params, environment, in_contact, reachable
from .taylor import (
    ORDER,
    Polynomial,
    crossing,
    derivative,
    first_exit,
    series,
    sign_changes,
    step_size,
    value,
)

METRICS = (
    "nmse",
    "nmse_tail",
    "convergence_time",
    "steady_error",
    "peak_torque",
    "overshoot",
    "contact_time",
    "contact_lost",
    "mode_switches",
    "energy_in",
)
POWERS = np.arange(ORDER + 1)
MEAN = 1.0 / (POWERS + 1.0)
"""Integrals of 1, t, t², ... from 0 to 1."""
PRODUCT = 1.0 / (POWERS[:, None] + POWERS[None, :] + 1.0)
"""Integrals of the products of two powers of t from 0 to 1."""


def metrics(
    p: Params, choices: Choices, t_end: float, tail_from: float | None = None
) -> dict[str, float]:
    """The metrics of model.md without a plant step; times in s, torques in N·m, energy in J.

    The tail begins at tail_from, t_end / 2 if not given ((n // 2) dt for a run of n steps).
    Raises Irregular as `events.simulate` does.
    """
    return measured(p, choices, t_end, tail_from).result()


def measured(p: Params, choices: Choices, t_end: float, tail_from: float | None = None) -> "Meter":
    """The meter after the run; arguments as for `metrics`."""
    meter = Meter(p, choices, t_end, 0.5 * t_end if tail_from is None else tail_from)
    run(p, choices, t_end, meter, cross)
    return meter


def cross(s: State, cell: Cell, t_stop: float, meter: "Meter") -> tuple[State, str | None]:
    """Move through one cell, to t_stop or to the line it leaves by ("x" or "v")."""
    while True:
        x, v = series(s, cell)
        h = min(step_size(v), t_stop - s.t)
        h, name = first_exit(x, v, cell, h)
        end = State(s.t + h, value(x, h), value(v, h), s.x_h, s.e_M)
        # On the line exactly, so that the next cell starts on its edge.
        if name == "x":
            end.x = cell.x_next
        elif name == "v":
            end.v = cell.v_low if end.v - cell.v_low < cell.v_high - end.v else cell.v_high
        elif h >= t_stop - s.t:
            end.t = t_stop
        meter.measure(s, cell, x, v, h)
        meter.work += cell.torque.work(s.x, end.x)
        if name is not None or end.t >= t_stop:
            return end, name
        s = end


class Meter:
    """Adds up the metrics while the motion goes on; an Observer of events.py."""

    def __init__(self, p: Params, choices: Choices, t_end: float, tail_from: float) -> None:
        self.Td, self.T_n = p["Td"], reachable(p)
        self.t_end, self.tail_from = t_end, tail_from
        self.square = self.tail_square = self.tail_eps = self.work = 0.0
        start = environment(p["x_init"], p["v_init"], p, choices["contact"]) / self.T_n
        self.size, self.largest = abs(start), start
        self.outside_until = 0.0
        touches = in_contact(p["x_init"], p, choices["contact"])
        self.first_touch = 0.0 if touches else inf
        self.free_since: float | None = None
        self.lost = 0.0
        self.branch: bool | None = None
        self.lasting: bool | None = None
        self.switches = self.lasting_switches = 0
        self.moved = self.came_to_rest = False

    def enter(self, t: float, cell: Cell) -> None:
        """Note contact and branch of the cell in which the motion goes on at time t (s)."""
        self.pass_through(cell.diverging)
        if cell.contact:
            self.first_touch = min(self.first_touch, t)
            if self.free_since is not None:
                self.lost += t - self.free_since
            self.free_since = None
        elif self.free_since is None and self.first_touch < inf:
            self.free_since = t

    def pass_through(self, diverging: bool) -> None:
        """Count a change of branch, also to a branch of one instant: `switches`, of no metric.

        `rk4` spends a step in such a branch, so its count tends to this one.
        """
        if self.branch is not None and self.branch != diverging:
            self.switches += 1
        self.branch = diverging

    def stay(self, diverging: bool) -> None:
        """Count a change to a branch in which the joint moves for some time."""
        if self.lasting is not None and self.lasting != diverging:
            self.lasting_switches += 1
        self.lasting = diverging

    def latch(self, t: float) -> None:
        """No metric looks at this."""

    def jump(self, e_before: float, before: Cell, s: State) -> None:
        """No metric looks at this."""

    def rest(self, s: State, cell: Cell, t_stop: float) -> None:
        """Integrate over the time in which nothing moves."""
        self.came_to_rest = self.moved
        self.measure(s, cell, [s.x, *[0.0] * ORDER], [0.0] * (ORDER + 1), t_stop - s.t)

    def measure(self, s: State, cell: Cell, x: Polynomial, v: Polynomial, h: float) -> None:
        """Integrals, extrema and band of T/T_n over a step of h seconds within a cell."""
        k, d = cell.reaction.Kenv / self.T_n, cell.reaction.Denv / self.T_n
        relative = [k * a + d * b for a, b in zip(x, v, strict=True)]
        relative[0] = cell.reaction(s.x, s.v) / self.T_n
        self.integrate(relative, s.t, h)
        self.moved = self.moved or v[0] != 0.0
        if h > 0.0 and any(v):
            self.stay(cell.diverging)
        turns = sign_changes(derivative(relative), h) if cell.reaction.Denv != 0.0 else []
        marks = [0.0, *turns, h]
        values = [value(relative, t) for t in marks]
        self.size = max(self.size, *map(abs, values))
        self.largest = max(self.largest, *values)
        for i in range(len(marks) - 1):
            before, after = values[i], values[i + 1]
            if abs(after - 1.0) > BAND:
                self.outside_until = s.t + marks[i + 1]
            elif abs(before - 1.0) > BAND:
                edge = 1.0 - BAND if before < 1.0 else 1.0 + BAND
                self.outside_until = s.t + crossing(relative, edge, marks[i], marks[i + 1])

    def integrate(self, relative: Polynomial, t: float, h: float) -> None:
        """Add ∫ε² from t to t + h, and ∫ε² and ∫ε over its part in the tail."""
        eps = np.array(relative)
        eps[0] -= self.Td / self.T_n

        def integrals(length: float) -> tuple[float, float]:
            scaled = eps * length**POWERS
            return length * float(scaled @ MEAN), length * float(scaled @ PRODUCT @ scaled)

        mean, square = integrals(h)
        self.square += square
        if t + h <= self.tail_from:
            return
        if t < self.tail_from:
            mean_before, square_before = integrals(self.tail_from - t)
            mean, square = mean - mean_before, square - square_before
        self.tail_square += square
        self.tail_eps += mean

    def result(self) -> dict[str, float]:
        """The metrics by their names in model.md."""
        tail = self.t_end - self.tail_from
        if self.free_since is not None:
            self.lost += self.t_end - self.free_since
        settled = self.t_end - self.outside_until >= LEAST_STAY * self.t_end
        return {
            "nmse": self.square / self.t_end,
            "nmse_tail": self.tail_square / tail,
            "convergence_time": self.outside_until if settled else inf,
            "steady_error": self.tail_eps / tail,
            "peak_torque": self.size * abs(self.T_n),
            "overshoot": max(self.largest - 1.0, 0.0),
            "contact_time": self.first_touch,
            "contact_lost": self.lost,
            "mode_switches": float(self.lasting_switches),
            "energy_in": self.work,
        }
