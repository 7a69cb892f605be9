"""The closed loop in continuous time under the sampled Algorithm 2, with located events.

This is the limit dt -> 0, at fixed `period`, of the discretisation in `discrete.py`. The mode is
decided by the signs of e and v and no longer once a step. The variants in this limit:

* Between ticks d|e|/dt = -sign(e) v, so `velocity` (e v <= 0) and `error_rate` (|e| grew) are
  the same rule except on the lines e = 0 and v = 0. `velocity_band` adds |v| < 0.01.
* e = 0: |e| falls before and grows after, so the motion always goes on diverging, with e_M = e.
* v = 0 (and |v| = 0.01 for the band): one side of the line diverges, or both. The discretisation
  spends at least one step there before it can leave on the other side, so e_M <- e in every
  variant, and afterwards the acceleration of each side with that e_M says where the motion goes.
  So a converging motion that stops short of x_h gets a new e_M. If the larger diverging torque
  then pushes it on, it converges again: a new peak (`latches`), with no lasting change of mode.
* Both sides leading back to the line is a sliding mode (`energy` with K0 x0 > Fmax):
  the discretisation chatters there, and the scenario is `Irregular`.
* A tick moves x_h and so e, at fixed x and v. `velocity`, `velocity_band`: the mode is the
  printed rule at the new e; e_M <- e when diverging, else e_M stays (it is the last e, just
  before the tick, if the motion was diverging). `error_rate` compares |e| just after the tick
  with |e| just before, since v dt -> 0. If |e| jumped up, the tick step counts as diverging and
  sets e_M <- e once; from the next step on the sign of e v decides again, so a converging
  motion keeps that e_M. If |e| jumped down, one step converges, which has no weight in the limit.
* At t = 0 the same holds with |e| = 0 before: `error_rate` sets e_M <- e(0) even if the motion
  starts converging, whereas `velocity` with `latched` keeps e_M = x_h - x_init from before the
  first tick.
* `running`: while converging |e| falls, and e_M, once set, has the sign of e and a larger size; so
  its two conditions can become true at a tick (or at t = 0) only, once.
* A branch that the rule names for one instant only is a branch too: the start at rest, the stop of
  a converging motion, a jump of |e| with `error_rate`. The discretisation spends a step in it,
  and `Observer.pass_through` hears of it.
* Motor feedback at a tick is the torque just before it, interaction feedback τ_env at that time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Protocol, TypeVar

import numpy as np
from scipy.integrate import solve_ivp  # type: ignore[import-untyped,unused-ignore]

from .cells import Cell, State, cell_at, levels
from .laws import Choices, Params, diverges, explore, first_measurement, start_reference
from .record import SAME_TIME, Record

RTOL, ATOL = 1e-10, 1e-12
MOST_EVENTS = 200
"""Events allowed within one period; more is taken for chattering or a Zeno sequence."""
LONGEST_STEP = 0.01
"""Longest integrator step in s: well below the half swing of the stiffest pair of springs, so
that v cannot leave a line v = 0 and come back to it unseen within one step."""
SLIGHT = 1e-6
"""Acceleration in rad/s² that counts as none at the edge of the band."""
REST = 1e-11
"""Acceleration in rad/s² that counts as none at v = 0. A swing from rest ends with v = 0 at e = 0,
where nothing pushes; rounding leaves up to 1e-12 of either sign there."""
SHORTEST_STEP = 1e-8
"""A motion that is back on its line v = const within this time (s) has not left it."""


@dataclass(frozen=True)
class Line:
    """A terminal event for solve_ivp: y[index] reaches `value`, going in `direction`."""

    name: str
    index: int
    value: float
    direction: float
    terminal: bool = True

    def __call__(self, _t: float, y: np.ndarray) -> float:
        """Zero on the line."""
        return float(y[self.index]) - self.value


class Observer(Protocol):
    """The metrics of the motion so far; times in s."""

    def enter(self, t: float, cell: Cell) -> None:
        """At time t the motion goes on in this cell."""

    def pass_through(self, diverging: bool) -> None:
        """The branch for one instant, before the cell of the next `enter`."""

    def latch(self, t: float) -> None:
        """A converging motion stopped and e_M was set again."""

    def jump(self, e_before: float, before: Cell, s: State) -> None:
        """A tick changed |e| under `error_rate`."""

    def rest(self, s: State, cell: Cell, t_stop: float) -> None:
        """Nothing moves until t_stop."""


R = TypeVar("R", bound=Observer)
Cross = Callable[[State, Cell, float, R], tuple[State, str | None]]
"""Moves a state through its cell until t_stop or the line it leaves by ("x" or "v")."""


class Irregular(Exception):  # noqa: N818 - a property of the scenario, no mistake of anybody
    """The limit dt -> 0 is not defined here: chattering, sliding or accumulating events."""


def simulate(
    p: Params, choices: Choices, t_end: float, t_eval: Sequence[float] | np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Samples t x v x_h e e_M diverging torque tau_env at t_eval (ascending, in s), and events.

    A sample at a tick shows the state just before it, as the last plant step does in the
    discretisation. Default times: the ends of all periods. Event times in s: `contact_made`
    (0 if it starts in contact), `contact_lost`, `switches` of the mode, and `latches`, where a
    converging motion stopped and e_M was set again. `margins` in s: see `Record.jump`; a
    discretisation with `error_rate` follows this solution only for dt well below all of them.
    """
    record = Record(periods(p, t_end) if t_eval is None else t_eval)
    run(p, choices, t_end, record, cross)
    return record.result()


def run(p: Params, choices: Choices, t_end: float, observer: R, cross: Cross[R]) -> None:
    """The motion from 0 to t_end: Algorithm 2 at every k period, `cross` in every cell."""
    x_h = start_reference(p)
    s = State(0.0, p["x_init"], p["v_init"], x_h, x_h - p["x_init"])
    F, cell = first_measurement(p, choices), None
    for stop in periods(p, t_end):
        e_before, before = s.e, cell
        s, cell = tick(s, cell, F, p, choices)
        if before is None:
            observer.pass_through(diverges(s.e, s.v, 0.0, choices["divergence"]))
        elif choices["divergence"] == "error_rate" and abs(s.e) != abs(e_before):
            observer.jump(e_before, before, s)
            observer.pass_through(abs(s.e) > abs(e_before))
        s, cell = travel(s, cell, stop, p, choices, observer, cross)
        F = cell.torque(s.x) if choices["feedback"] == "motor" else cell.reaction(s.x, s.v)


def periods(p: Params, t_end: float) -> list[float]:
    """The ends of all control periods in s; the last one is t_end."""
    n_ticks = int(np.ceil(t_end / p["period"] - SAME_TIME))
    return [min((k + 1) * p["period"], t_end) for k in range(n_ticks)]


def tick(
    s: State, before: Cell | None, F: float, p: Params, choices: Choices
) -> tuple[State, Cell]:
    """Algorithm 2; the jump of x_h may change mode and e_M (see the top of this file)."""
    expectation = choices.get("expectation", "displacement")
    e_before = s.e if before is not None else 0.0
    e_M = e_before if before is not None and before.diverging else s.e_M
    s = State(s.t, s.x, s.v, explore(s.x, s.x_h, F, p, expectation), e_M)
    if s.v in levels(choices):
        return settle(s, p, choices)
    if choices["divergence"] == "error_rate" and abs(s.e) > abs(e_before):
        s.e_M = s.e
    cell = cell_at(s, 0, p, choices)
    grew = abs(s.e) > abs(s.e_M) or s.e * s.e_M < 0.0
    if cell.diverging or (choices["peak"] == "running" and grew):
        s.e_M = s.e
        cell = cell_at(s, 0, p, choices)
    return s, cell


def settle(s: State, p: Params, choices: Choices) -> tuple[State, Cell]:
    """Leave a line v = const on the side to which the motion goes, with e_M <- e.

    The diverging side comes first, as the discretisation starts there. At v = 0 with nothing
    pushing, the motion rests (zero acceleration) until the next tick. At the band's edge with
    nothing pushing it enters the band, since all springs then slow it: so ends a swing with its
    peak at the edge (back at e = 0 with the speed it left with) and a series of ever shorter
    excursions from the edge.
    """
    s = State(s.t, s.x, s.v, s.x_h, s.e)
    sides = [(side, cell_at(s, side, p, choices)) for side in (1, -1)]
    sides.sort(key=lambda pair: not pair[1].diverging)
    if s.v != 0.0 and all(abs(cell.acceleration(s.x, s.v)) < SLIGHT for _, cell in sides):
        s.v *= 1.0 - ATOL
        return s, cell_at(s, 0, p, choices)
    at_rest = [s.v == 0.0 and abs(cell.acceleration(s.x, 0.0)) <= REST for _, cell in sides]
    if all(at_rest):
        return s, sides[0][1]
    for side, cell in sides:
        if side * cell.acceleration(s.x, s.v) > 0.0:
            return s, cell
    if at_rest[0]:
        return s, sides[0][1]
    raise Irregular(f"sliding along v = {s.v:g} at t = {s.t:.6g}")


def travel(
    s: State,
    cell: Cell,
    t_stop: float,
    p: Params,
    choices: Choices,
    observer: R,
    cross: Cross[R],
) -> tuple[State, Cell]:
    """From event to event until t_stop; returns the state there and the cell it is in."""
    for _ in range(MOST_EVENTS):
        observer.enter(s.t, cell)
        # Nothing more moves: the last event came at t_stop itself, or the motion rests.
        if s.t >= t_stop or (s.v == 0.0 and abs(cell.acceleration(s.x, 0.0)) <= REST):
            observer.rest(s, cell, t_stop)
            return State(t_stop, s.x, s.v, s.x_h, s.e_M), cell
        s, hit = cross(s, cell, t_stop, observer)
        if hit is None:
            return s, cell
        if hit == "v":
            if not cell.diverging:
                observer.latch(s.t)
            observer.pass_through(True)
            s, cell = settle(s, p, choices)
        else:
            if cell.diverging:
                s.e_M = s.e
            cell = cell_at(s, 0, p, choices)
    raise Irregular(f"more than {MOST_EVENTS} events in the period before t = {t_stop:.6g}")


def cross(s: State, cell: Cell, t_stop: float, record: Record) -> tuple[State, str | None]:
    """Integrate through one cell, to t_stop or to the line it leaves by ("x" or "v")."""
    lines = [
        Line("x", 0, cell.x_next, cell.heading),
        Line("v", 1, cell.v_low, -1.0),
        Line("v", 1, cell.v_high, 1.0),
    ]
    lines = [line for line in lines if abs(line.value) < inf]
    due = record.due(t_stop)
    solution = integrate(s, cell, t_stop, lines, [*due[due < t_stop], t_stop])
    # solve_ivp hands back an empty list when the event comes before the first requested time.
    samples = np.reshape(solution.y, (2, -1)).T.tolist()
    for x, v in samples[: len(due)]:
        record.sample(x, v, s, cell)
    hits = [i for i, times in enumerate(solution.t_events) if len(times)]
    if not hits:
        x, v = samples[-1]
        return State(t_stop, x, v, s.x_h, s.e_M), None
    line, t, y = lines[hits[0]], solution.t_events[hits[0]][0], solution.y_events[hits[0]][0]
    # Put the state exactly on the line, so that the next cell starts on its edge.
    y[line.index] = line.value
    return State(float(t), float(y[0]), float(y[1]), s.x_h, s.e_M), line.name


def integrate(s: State, cell: Cell, t_stop: float, lines: list[Line], times: list[float]) -> Any:
    """solve_ivp within one cell until the first line; its result object.

    A motion that starts on a line and is back on it within the first step would be reported as
    an event at its start, so the step is shortened until the motion gets away from there (or
    has not left, and the event at its start is true).
    """

    def rates(_t: float, y: np.ndarray) -> tuple[float, float]:
        x, v = y.tolist()
        return v, cell.acceleration(x, v)

    longest = LONGEST_STEP
    while True:
        solution = solve_ivp(
            rates,
            (s.t, t_stop),
            (s.x, s.v),
            method="DOP853",
            t_eval=times,
            events=lines,
            rtol=RTOL,
            atol=ATOL,
            max_step=longest,
        )
        if not solution.success:
            raise Irregular(f"{solution.message} at t = {s.t:.6g}")
        hits = zip(lines, solution.t_events, strict=True)
        stuck = any(line.name == "v" and s.t in times_hit for line, times_hit in hits)
        if not stuck or longest < SHORTEST_STEP:
            return solution
        longest /= 8.0
