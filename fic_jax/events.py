"""One plant step by RK4 with its switches located inside it.

The law switches at v = 0, e = 0, |e| = x0 and |e| = xb, the environment at x = gap. The first
switch divides the step into two segments. A point just ahead of a segment's start chooses its piece
of the closed loop. The first segment ends where RK4's interpolant crosses to the next piece. The
kink at the limit +-Fmax (K0 x0 > Fmax, or |e| above |e_M|) is not located.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from fic_jax.controller import (
    REST_BAND,
    Attractor,
    Slopes,
    begin_branch,
    departs,
    diverges,
    peak_error_after,
    torque,
)
from fic_jax.lanes.hints import where_rare
from fic_jax.params import Model, Params, Scalar
from fic_jax.rk4 import Motion, Stages, end_of, net_torque, stages, step_sizes

# The point that chooses a segment's piece lies this part of a plant step ahead of its start.
AHEAD = 2.0**-10
# rad/s, where a motion meets the edge of the rest band: 1e-9 inside, so that it counts as at rest
# until it has left. An acceleration below 1e-9 rad/s in AHEAD of a step counts as none.
BAND_EDGE = (1.0 - 1e-7) * REST_BAND


def advance_located(
    p: Params,
    start: Motion,
    x_h: Scalar,
    e_M: Scalar,
    e_last: Scalar,
    known: Slopes | None,
    model: Model,
    dt: Scalar,
) -> tuple[Motion, Attractor]:
    """One plant step of `dt` seconds, and the attractor of its last segment.

    The first segment ends at the first switch, the second at the end of the step. A second switch
    in one step acts at the next step only: an error of first order. `e_last` is |e| (rad) before
    this step's tick of Algorithm 2.
    """
    grown = jnp.zeros_like(start.x, bool)
    if model.divergence == "error_rate":  # by the tick; within a step the sign of e v decides
        grown = diverges(x_h - start.x, start.v, e_last, model)
    before, side = enter(p, start, x_h, e_M, grown, known, model, dt)
    k = stages(p, start, x_h, before, model, dt, side)
    part, switch = until_switch(p, start, x_h, k, model, dt)

    def after_switch() -> tuple[Motion, Attractor]:
        left = (1.0 - part) * dt
        e_M = peak_error_after(before, x_h - switch.x)
        nowhere = jnp.zeros_like(grown)
        after, side = enter(p, switch, x_h, e_M, nowhere, before.slopes, model, dt)
        k = stages(p, switch, x_h, after, model, left, side)
        return end_of(switch, k, step_sizes(p, left)), after

    return where_rare(part < 1.0, after_switch, (switch, before))


def enter(
    p: Params,
    at: Motion,
    x_h: Scalar,
    e_M: Scalar,
    grown: Scalar,
    known: Slopes | None,
    model: Model,
    dt: Scalar,
) -> tuple[Attractor, Motion]:
    """The attractor of the segment that starts at `at`, and the point ahead that chooses its piece.

    At rest both branches are possible. Algorithm 1 first diverges, with e_M = e; the acceleration
    that follows decides the direction, and so the branch.
    """
    e = x_h - at.x
    diverging = departs(e, at.v, model)
    first = begin_branch(e, diverging, jnp.where(grown, e, e_M), p, model, known)
    tau = torque(e, first, p)
    soon = AHEAD * dt
    v = at.v + step_sizes(p, soon).v * net_torque(p, tau, at.x, at.v, model)
    way = 0.5 * soon * (at.v + v)
    # Four units in the last place more: otherwise rounding leaves a slow motion on the switch.
    least = 4.0 * jnp.finfo(at.x.dtype).eps * (jnp.abs(at.x) + jnp.abs(x_h))
    way = jnp.where(way < 0.0, way - least, way + least)
    ahead = jax.lax.stop_gradient(Motion(at.x + way, v, at.work))  # only compared with levels
    diverging = diverging & departs(x_h - ahead.x, ahead.v, model)
    return begin_branch(e, diverging, first.e_M, p, model, first.slopes), ahead


def until_switch(
    p: Params, start: Motion, x_h: Scalar, k: Stages, model: Model, h: Scalar
) -> tuple[Scalar, Motion]:
    """The part of `h` up to the segment's first switch, 1 without one, and the motion there.

    The crossing of v comes first: up to v = 0 the position is monotonic and takes each value once.
    A v that crosses 0 twice within the segment goes unnoticed.
    """
    size = step_sizes(p, h)
    path, end = Interpolant.of(start, k, size), end_of(start, k, size)
    whole = jnp.ones_like(start.v)
    v_level, stops = _first_between(_speed_levels(model), start.v, end.v)
    stop = where_rare(
        stops, lambda: path.part_at("v", v_level - start.v, end.v - start.v, whole), whole
    )
    farthest = jnp.where(stops, path.at(stop).x, end.x)
    x_level, passes = _first_between(_position_levels(p, x_h, model), start.x, farthest)
    part = where_rare(
        passes, lambda: path.part_at("x", x_level - start.x, farthest - start.x, stop), stop
    )
    at = path.at(part)
    # Exactly on the level, so that the next segment does not cross it a second time.
    x = jnp.where(passes, x_level, jnp.where(stops, at.x, end.x))
    v = jnp.where(passes, at.v, jnp.where(stops, v_level, end.v))
    return part, Motion(x, v, jnp.where(passes | stops, at.work, end.work))


def _speed_levels(model: Model) -> tuple[float, ...]:
    return (-BAND_EDGE, 0.0, BAND_EDGE) if model.divergence == "velocity_band" else (0.0,)


def _position_levels(p: Params, x_h: Scalar, model: Model) -> tuple[Scalar, ...]:
    levels = (x_h, x_h - p.x0, x_h + p.x0, x_h - p.xb, x_h + p.xb)
    return levels if model.contact == "welded" else (*levels, p.gap)


def _first_between(levels: tuple[Scalar, ...], start: Scalar, end: Scalar) -> tuple[Scalar, Scalar]:
    """The first of the levels strictly between start and end, and whether there is one."""
    first = end
    for level in levels:
        first = jnp.where((level - start) * (first - level) > 0.0, level, first)
    return first, (first < end) | (first > end)


@dataclass(frozen=True)
class Interpolant:
    """RK4's continuous extension of third order: the motion at a part of the step, a cubic."""

    start: Motion
    linear: Motion
    square: Motion
    cubic: Motion

    @classmethod
    def of(cls, start: Motion, k: Stages, size: Motion) -> "Interpolant":
        """Hairer, Norsett, Wanner 1993, II.6: continuous extension of the classic method."""

        def square(h: Scalar, a: Scalar, b: Scalar, c: Scalar, d: Scalar) -> Scalar:
            return h * (b + c - 1.5 * a - 0.5 * d)

        def cubic(h: Scalar, a: Scalar, b: Scalar, c: Scalar, d: Scalar) -> Scalar:
            return (2.0 / 3.0) * h * (a - b - c + d)

        linear = jax.tree.map(lambda h, a: h * a, size, k[0])
        return cls(start, linear, jax.tree.map(square, size, *k), jax.tree.map(cubic, size, *k))

    def at(self, part: Scalar) -> Motion:
        """The motion at a part of the step."""

        def value(y: Scalar, a: Scalar, b: Scalar, c: Scalar) -> Scalar:
            return y + part * (a + part * (b + part * c))

        return jax.tree.map(value, self.start, self.linear, self.square, self.cubic)

    def part_at(self, name: str, rise: Scalar, rise_to: Scalar, until: Scalar) -> jax.Array:
        """The part of the step, up to `until`, at which coordinate `name` has risen by `rise`.

        At `until` it has risen by `rise_to`. Newton's method, bounded, from the parabola with the
        first slope and both ends. Only the last correction is differentiated: that is the implicit
        function theorem.
        """
        a, b, c = (getattr(k, name) for k in (self.linear, self.square, self.cubic))

        def corrected(part: Scalar, a: Scalar, b: Scalar, c: Scalar, rise: Scalar) -> jax.Array:
            slope = jax.lax.stop_gradient(a + part * (2.0 * b + part * 3.0 * c))
            miss = part * (a + part * (b + part * c)) - rise
            return part - _quotient(miss, slope)

        fixed = jax.lax.stop_gradient((a, b, c, rise))
        until = jax.lax.stop_gradient(until)
        part = jax.lax.stop_gradient(_parabola(a, rise, rise_to, until))
        if jnp.finfo(part.dtype).eps < 1e-10:  # double precision takes one correction more
            part = jnp.clip(corrected(part, *fixed), 0.0, until)
        return jnp.clip(corrected(jnp.clip(part, 0.0, until), a, b, c, rise), 0.0, until)


def _parabola(a: Scalar, rise: Scalar, rise_to: Scalar, until: Scalar) -> jax.Array:
    """The t where a t + q t^2 = `rise`, q such that it is `rise_to` at `until`; also if a = 0."""
    q = _quotient(rise_to - a * until, until**2)
    inside = a**2 + 4.0 * q * rise
    root = jnp.sqrt(jnp.where(inside > 0.0, inside, 0.0))
    return _quotient(2.0 * rise, a + jnp.where(rise < 0.0, -root, root))


def _quotient(a: Scalar, b: Scalar) -> jax.Array:
    """a/b, 0 where |b| is below the smallest normal number."""
    tiny = jnp.abs(b) < jnp.finfo(b.dtype).tiny
    return jnp.where(tiny, 0.0, a / jnp.where(tiny, 1.0, b))
