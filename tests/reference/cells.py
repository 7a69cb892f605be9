"""One smooth piece of the continuous closed loop: a box of the (x, v) plane and its equations.

All switches of plant and controller are lines x = const or v = const while x_h and e_M stand
still, so the plane between two ticks is a grid of boxes, and inside a box the equations are
smooth. Velocity keeps its sign in a box, hence x moves one way and can only leave through the
nearest line ahead. A box decides everything at its own centre, never on its edge, so rounding
at a located event cannot pick the wrong side.
"""

from bisect import bisect_right
from dataclasses import dataclass
from math import copysign, exp, inf

from .laws import STILL, Choices, Params, force, in_contact, slope


@dataclass
class State:
    """The state of the closed loop: plant, reference and attractor. Units rad, rad/s, s."""

    t: float
    x: float
    v: float
    x_h: float
    e_M: float

    @property
    def e(self) -> float:
        """The error x_h - x in rad."""
        return self.x_h - self.x


@dataclass(frozen=True)
class Spring:
    """A spring, stiffness in N·m/rad, that is at rest at x = rest (rad)."""

    stiffness: float
    rest: float

    def __call__(self, x: float) -> float:
        """Torque in N·m."""
        return self.stiffness * (self.rest - x)

    def work(self, start: float, end: float) -> float:
        """∫ torque dx from start to end, in J."""
        return self.stiffness * (self.rest - 0.5 * (start + end)) * (end - start)


@dataclass(frozen=True)
class Bend:
    """The exponential part of eq. 1 on the side where e has the given sign."""

    x_h: float
    sign: float
    x0: float
    b: float
    p: Params

    @property
    def dF(self) -> float:
        """ΔF = Fmax - K0 x0 in N·m."""
        return self.p["Fmax"] - self.p["K0"] * self.x0

    def missing(self, x: float) -> float:
        """The share of ΔF that the torque still lacks: exp(-(|e| - x0) / b)."""
        return exp(-(self.sign * (self.x_h - x) - self.x0) / self.b)

    def __call__(self, x: float) -> float:
        """Torque in N·m."""
        return self.sign * (self.dF * (1.0 - self.missing(x)) + self.p["K0"] * self.x0)

    def work(self, start: float, end: float) -> float:
        """∫ torque dx from start to end, in J."""
        left = self.missing(end) - self.missing(start)
        return self.sign * self.p["Fmax"] * (end - start) - self.dF * self.b * left


@dataclass(frozen=True)
class Constant:
    """A constant torque in N·m."""

    value: float

    def __call__(self, x: float) -> float:
        """Torque in N·m."""
        return self.value

    def work(self, start: float, end: float) -> float:
        """∫ torque dx from start to end, in J."""
        return self.value * (end - start)


Piece = Spring | Bend | Constant


@dataclass(frozen=True)
class Reaction:
    """The environment Kenv (x - gap) + Denv v in N·m; both 0 out of contact."""

    Kenv: float
    Denv: float
    gap: float

    def __call__(self, x: float, v: float) -> float:
        """Torque in N·m."""
        return self.Kenv * (x - self.gap) + self.Denv * v


@dataclass(frozen=True)
class Cell:
    """A box v_low..v_high, x up to x_next, with the one smooth law that holds inside it."""

    v_low: float
    v_high: float
    heading: float
    x_next: float
    diverging: bool
    contact: bool
    torque: Piece
    reaction: Reaction
    inertia: float

    def acceleration(self, x: float, v: float) -> float:
        """ẍ = (torque - τ_env) / I in rad/s²."""
        return (self.torque(x) - self.reaction(x, v)) / self.inertia


def levels(choices: Choices) -> tuple[float, ...]:
    """The lines v = const in rad/s at which the mode can change, between -inf and inf."""
    if choices["divergence"] == "velocity_band":
        return (-inf, -STILL, 0.0, STILL, inf)
    return (-inf, 0.0, inf)


def cell_at(s: State, side: int, p: Params, choices: Choices) -> Cell:
    """The box that the state is in; if v is on a line, the box above (+1) or below (-1) it."""
    v_low, v_high = box_of_speed(s.v, side, levels(choices))
    heading = 1.0 if v_low >= 0.0 else -1.0
    # On the line e = 0 the motion itself says which sign e is about to have.
    sign = copysign(1.0, s.e) if s.e != 0.0 else -heading
    still = choices["divergence"] == "velocity_band" and max(-v_low, v_high) <= STILL
    diverging = still or sign * heading < 0.0
    x_next = next_line(s, heading, diverging, p)
    centre = 0.5 * (s.x + x_next) if abs(x_next) < inf else s.x + heading
    contact = in_contact(centre, p, choices["contact"])
    return Cell(
        v_low=v_low,
        v_high=v_high,
        heading=heading,
        x_next=x_next,
        diverging=diverging,
        contact=contact,
        torque=torque_piece(s.x_h - centre, s, diverging, p, choices["law"]),
        reaction=reaction_piece(contact, heading, p, choices["contact"]),
        inertia=p["I"],
    )


def box_of_speed(v: float, side: int, lines: tuple[float, ...]) -> tuple[float, float]:
    """The neighbouring lines that enclose v, in rad/s."""
    i = bisect_right(lines, v)
    if v == lines[i - 1] and side < 0:
        i -= 1
    return lines[i - 1], lines[i]


def next_line(s: State, heading: float, diverging: bool, p: Params) -> float:
    """The nearest x ahead, in rad, where the law changes: ±inf if there is none.

    The lines are contact, e = 0, |e| = x0, |e| = xb and where the torque limit is reached.
    """
    errors = [0.0, p["x0"], -p["x0"], p["xb"], -p["xb"]]
    if diverging:
        errors += [p["Fmax"] / p["K0"], -p["Fmax"] / p["K0"]]
    else:
        for e in (0.0, 2.0 * p["xb"]):
            for law in ("effort", "energy"):
                reach = p["Fmax"] / slope(e, s.e_M, p, law)
                errors += [0.5 * s.e_M + reach, 0.5 * s.e_M - reach]
    lines = [s.x_h - e for e in errors] + [p["gap"]]
    if heading > 0.0:
        return min((x for x in lines if x > s.x), default=inf)
    return max((x for x in lines if x < s.x), default=-inf)


def torque_piece(e: float, s: State, diverging: bool, p: Params, law: str) -> Piece:
    """Algorithm 1 as a smooth function of x (N·m): the branch that holds at the error e."""
    x_h = s.x_h
    piece: Piece
    if not diverging:
        piece = Spring(slope(e, s.e_M, p, law), x_h - 0.5 * s.e_M)
    elif abs(e) < p["x0"]:
        piece = Spring(p["K0"], x_h)
    elif abs(e) < p["xb"]:
        piece = Bend(x_h, copysign(1.0, e), p["x0"], (p["xb"] - p["x0"]) / p["S"], p)
    else:
        piece = Constant(force(e, p))
    if abs(piece(x_h - e)) > p["Fmax"]:
        return Constant(copysign(p["Fmax"], piece(x_h - e)))
    return piece


def reaction_piece(contact: bool, heading: float, p: Params, kind: str) -> Reaction:
    """The environment's τ_env(x, v) in N·m as a smooth function; v keeps the heading's sign."""
    if not contact:
        return Reaction(0.0, 0.0, p["gap"])
    # The hard stop rebounds undamped: Denv max(v, 0) is 0 throughout a box with v < 0.
    Denv = 0.0 if kind == "hard_stop" and heading < 0.0 else p["Denv"]
    return Reaction(p["Kenv"], Denv, p["gap"])
