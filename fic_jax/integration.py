"""How x and v move through one plant step: classic RK4, with the switches inside it located or not.

The law switches at v = 0, e = 0, |e| = x0 and |e| = xb, the environment where contact is made or
lost. `advance` is Simulink's ode4: branch and e_M are held for the step, the rest switches at
whichever stage meets it, and a switch costs an error of first order. `advance_located` cuts the
step at its first switch: each segment stays on one piece of the closed loop, chosen by a point
just ahead of its start, and ends where the step's own interpolant crosses to the next. The limit
+-Fmax, a kink where K0 x0 > Fmax or e outgrows e_M, is not located.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

from fic_jax.controller import REST_BAND, Attractor, departs, diverges, latch, left_behind, torque
from fic_jax.environment import interaction_torque
from fic_jax.params import Model, Params, Scalar

# Segments of a located step: up to a switch and on to the end. A second switch in one step is met
# late, at the next step, to first order; a third segment costs 1.5 times and gained nothing.
SEGMENTS = 2
# The point that chooses a segment's pieces lies this part of a plant step ahead of its start.
AHEAD = 2.0**-10
# Where a motion meets the band at rest: within it, so that it counts as at rest until it is out. An
# acceleration that takes longer than AHEAD of a step for this 1e-9 rad/s is taken for none.
BAND_EDGE = (1.0 - 1e-7) * REST_BAND


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Motion:
    """Position and velocity, and the work the controller has done in this plant step.

    Also what belongs to each of the three: slopes (rad/s, N*m, W) and spans (s, s/(kg*m^2), s).
    """

    x: Scalar  # rad
    v: Scalar  # rad/s
    work: Scalar  # J


# What drives a motion at RK4's four stages: velocity, torque (which I divides) and power.
Slopes = tuple[Motion, Motion, Motion, Motion]


def net_torque(
    p: Params, tau: Scalar, x: Scalar, v: Scalar, model: Model, side: Motion | None = None
) -> jax.Array:
    """I x'' = torque - tau_env, N*m; `side` as in `stages`."""
    x_v = None if side is None else (side.x, side.v)
    return tau - interaction_torque(x, v, p, model, x_v)


def spans(p: Params, h: Scalar) -> Motion:
    """What each slope is multiplied by in `h` seconds: for the velocity h/I, the same in all steps.

    A division of the torques by I at each stage would stand in the way of the next stage.
    """
    return Motion(h, h * (1.0 / p.I), h)


def stages(
    p: Params,
    start: Motion,
    x_h: Scalar,
    attractor: Attractor,
    model: Model,
    h: Scalar,
    side: Motion | None = None,
) -> Slopes:
    """The four slopes of I x'' = torque - tau_env over `h` seconds; x_h and attractor are held.

    `side`: the point that chooses the pieces of law and contact, by default each stage's own.
    """
    span = spans(p, h)

    def slope(x: Scalar, v: Scalar) -> Motion:
        e_side = None if side is None else x_h - side.x
        tau = torque(x_h - x, attractor, p, model, e_side)
        return Motion(v, net_torque(p, tau, x, v, model, side), tau * v)

    def further(part: float, by: Motion) -> Motion:
        return slope(start.x + part * span.x * by.x, start.v + part * span.v * by.v)

    first = slope(start.x, start.v)
    second = further(0.5, first)
    third = further(0.5, second)
    return first, second, third, further(1.0, third)


def end_of(start: Motion, slopes: Slopes, span: Motion) -> Motion:
    """Where the slopes lead over `span`, to fourth order."""

    def quadrature(y: Scalar, h: Scalar, k1: Scalar, k2: Scalar, k3: Scalar, k4: Scalar) -> Scalar:
        return y + (1.0 / 6.0) * h * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    return jax.tree.map(quadrature, start, span, *slopes)


def advance(
    p: Params, start: Motion, x_h: Scalar, attractor: Attractor, model: Model, dt: Scalar
) -> Motion:
    """Classic RK4 (Simulink's ode4); branch, e_M and x_h are held, all else is as each stage's."""
    return end_of(start, stages(p, start, x_h, attractor, model, dt), spans(p, dt))


def advance_located(
    p: Params, start: Motion, x_h: Scalar, e_M: Scalar, e_last: Scalar, model: Model, dt: Scalar
) -> tuple[Motion, Attractor]:
    """RK4 from switch to switch; `e_last` is |e| before this step's tick of Algorithm 2 (rad).

    Also returns the attractor of the last segment.
    """
    nowhere = jnp.zeros_like(start.x, bool)
    grown = nowhere
    if model.divergence == "error_rate":  # grown by the tick; within a step e v says so
        grown = diverges(x_h - start.x, start.v, e_last, model)
    motion, left = start, dt
    attractor, side = enter(p, motion, x_h, e_M, grown, model, dt)
    for _ in range(SEGMENTS - 1):
        slopes = stages(p, motion, x_h, attractor, model, left, side)
        part, motion = until_switch(p, motion, x_h, slopes, model, left)
        left = jnp.where(part < 1.0, (1.0 - part) * left, 0.0)
        e_M = left_behind(attractor, x_h - motion.x)
        entered = enter(p, motion, x_h, e_M, nowhere, model, dt)
        attractor, side = _where(left > 0.0, entered, (attractor, side))
    slopes = stages(p, motion, x_h, attractor, model, left, side)
    return _where(left > 0.0, end_of(motion, slopes, spans(p, left)), motion), attractor


def enter(
    p: Params, at: Motion, x_h: Scalar, e_M: Scalar, grown: Scalar, model: Model, dt: Scalar
) -> tuple[Attractor, Motion]:
    """The attractor of the segment that starts at `at`, and the point ahead that chooses pieces.

    At rest both branches are possible. Algorithm 1 begins to diverge there, with e_M at e, and
    the acceleration that gives says which way the joint goes.
    """
    e = x_h - at.x
    attractor = latch(e, departs(e, at.v, model), e_M, p, model, grown)
    tau = torque(e, attractor, p, model)
    soon = AHEAD * dt
    v = at.v + spans(p, soon).v * net_torque(p, tau, at.x, at.v, model)
    way = 0.5 * soon * (at.v + v)
    # And some units of the last place, or a slow motion would not get off the switch.
    least = 4.0 * jnp.finfo(at.x.dtype).eps * (jnp.abs(at.x) + jnp.abs(x_h))
    way = jnp.where(way < 0.0, way - least, way + least)
    ahead = jax.lax.stop_gradient(Motion(at.x + way, v, at.work))  # it is only compared
    diverging = attractor.diverging & departs(x_h - ahead.x, ahead.v, model)
    return replace(attractor, diverging=diverging), ahead


def until_switch(
    p: Params, start: Motion, x_h: Scalar, slopes: Slopes, model: Model, h: Scalar
) -> tuple[Scalar, Motion]:
    """Follow a segment to its first switch: the part of `h` it takes, 1 if there is none.

    First v, as x only turns where v is 0: until then each x comes but once. A v that crosses 0
    and is back within the segment is not seen.
    """
    span = spans(p, h)
    path, end = Path.of(start, slopes, span), end_of(start, slopes, span)
    v_next, stops = _first(_speed_levels(model), start.v, end.v)
    whole = jnp.ones_like(start.v)
    turn = jnp.where(stops, path.part_at("v", v_next - start.v, end.v - start.v, whole), whole)
    farthest = jnp.where(stops, path.at(turn).x, end.x)
    x_next, passes = _first(_position_levels(p, x_h, model), start.x, farthest)
    pass_ = path.part_at("x", x_next - start.x, farthest - start.x, turn)
    part = jnp.where(passes, pass_, turn)
    there = path.at(part)
    # On the switch itself, so that it isn't found again from the other side.
    x = jnp.where(passes, x_next, jnp.where(stops, there.x, end.x))
    v = jnp.where(passes, there.v, jnp.where(stops, v_next, end.v))
    return part, Motion(x, v, jnp.where(passes | stops, there.work, end.work))


def _speed_levels(model: Model) -> tuple[float, ...]:
    return (-BAND_EDGE, 0.0, BAND_EDGE) if model.divergence == "velocity_band" else (0.0,)


def _position_levels(p: Params, x_h: Scalar, model: Model) -> tuple[Scalar, ...]:
    levels = (x_h, x_h - p.x0, x_h + p.x0, x_h - p.xb, x_h + p.xb)
    return levels if model.contact == "welded" else (*levels, p.gap)


def _first(levels: tuple[Scalar, ...], start: Scalar, end: Scalar) -> tuple[Scalar, Scalar]:
    """The first of the levels strictly between start and end, and whether there is one."""
    first = end
    for level in levels:
        first = jnp.where((level - start) * (first - level) > 0.0, level, first)
    return first, (first < end) | (first > end)


@dataclass(frozen=True)
class Path:
    """RK4's own interpolant of third order: the motion at a part of the step, a cubic."""

    start: Motion
    linear: Motion
    square: Motion
    cubic: Motion

    @classmethod
    def of(cls, start: Motion, slopes: Slopes, span: Motion) -> "Path":
        """Hairer, Norsett, Wanner 1993, II.6: continuous extension of the classic method."""

        def square(h: Scalar, a: Scalar, b: Scalar, c: Scalar, d: Scalar) -> Scalar:
            return h * (b + c - 1.5 * a - 0.5 * d)

        def cubic(h: Scalar, a: Scalar, b: Scalar, c: Scalar, d: Scalar) -> Scalar:
            return (2.0 / 3.0) * h * (a - b - c + d)

        linear = jax.tree.map(lambda h, a: h * a, span, slopes[0])
        squares = jax.tree.map(square, span, *slopes)
        return cls(start, linear, squares, jax.tree.map(cubic, span, *slopes))

    def at(self, part: Scalar) -> Motion:
        """The motion at a part of the step."""

        def value(y: Scalar, a: Scalar, b: Scalar, c: Scalar) -> Scalar:
            return y + part * (a + part * (b + part * c))

        return jax.tree.map(value, self.start, self.linear, self.square, self.cubic)

    def part_at(self, name: str, rise: Scalar, rise_to: Scalar, until: Scalar) -> jax.Array:
        """The part of the step, up to `until`, at which coordinate `name` has risen by `rise`.

        At `until` it has risen by `rise_to`. Newton's corrections, kept in bounds, from the
        parabola that has the first slope and both ends. Only the last one is differentiated:
        there it is the implicit function theorem.
        """
        a, b, c = (getattr(k, name) for k in (self.linear, self.square, self.cubic))

        def corrected(part: Scalar, a: Scalar, b: Scalar, c: Scalar, rise: Scalar) -> jax.Array:
            slope = jax.lax.stop_gradient(a + part * (2.0 * b + part * 3.0 * c))
            miss = part * (a + part * (b + part * c)) - rise
            return part - _quotient(miss, slope)

        fixed = jax.lax.stop_gradient((a, b, c, rise))
        until = jax.lax.stop_gradient(until)
        part = jax.lax.stop_gradient(_parabola(a, rise, rise_to, until))
        if jnp.finfo(part.dtype).eps < 1e-10:  # one correction more for double precision
            part = jnp.clip(corrected(part, *fixed), 0.0, until)
        return jnp.clip(corrected(jnp.clip(part, 0.0, until), a, b, c, rise), 0.0, until)


def _parabola(a: Scalar, rise: Scalar, rise_to: Scalar, until: Scalar) -> jax.Array:
    """Where a t + q t^2 is `rise`, if it is `rise_to` at t = `until`: near a turn as elsewhere."""
    q = _quotient(rise_to - a * until, until**2)
    inside = a**2 + 4.0 * q * rise
    root = jnp.sqrt(jnp.where(inside > 0.0, inside, 0.0))
    return _quotient(2.0 * rise, a + jnp.where(rise < 0.0, -root, root))


def _quotient(a: Scalar, b: Scalar) -> jax.Array:
    """a/b, 0 where b is next to nothing."""
    nothing = jnp.abs(b) < jnp.finfo(b.dtype).tiny
    return jnp.where(nothing, 0.0, a / jnp.where(nothing, 1.0, b))


def _where(condition: Scalar, this: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), this, other)
