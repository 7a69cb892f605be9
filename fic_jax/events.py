"""The motion from switch to switch: `rk4_events`, with switches located inside the plant step.

The law switches at v = 0, e = 0, |e| = x0, |e| = xb and where the torque meets its limit, the
environment at x = gap. A piece of the closed loop (piece.py) ends where its path crosses to the
next one, or with the plant step.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from fic_jax.controller import REST_BAND, Attractor, Slopes
from fic_jax.inputs import Scalar
from fic_jax.lanes.hints import where_rare
from fic_jax.params import Model, Params
from fic_jax.piece import (
    Arrival,
    Path,
    Piece,
    enter,
    law_at,
    path_of,
    swept,
    whole,
)

# Pieces of a plant step. The last one lasts to the end of the step: a switch that it passes acts at
# the next step, an error of first order.
PIECES = 4
# An extreme of tau_env between two ends that exceeds them by less than this part is left out.
FLAT = 1e-9
# rad/s, the speed of a motion that has just entered the rest band: inside it, so that it counts as
# at rest until it has left.
INSIDE_BAND = (1.0 - 1e-7) * REST_BAND


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Interval:
    """What happens in a plant step, or between two switches of it, and its end.

    T is tau_env. Means are over the plant step, so that those of its intervals add up.
    """

    x: Scalar  # rad, at the end
    v: Scalar  # rad/s, at the end
    tau: Scalar  # N*m, at the end
    T: Scalar  # N*m, at the end
    attractor: Attractor
    part: Scalar  # of the plant step that it takes
    ends_step: Scalar  # bool
    work: Scalar  # J
    error: Scalar  # N*m, mean of T - Td
    square: Scalar  # (N*m)^2, mean of (T - Td)^2
    highest: Scalar  # N*m, largest T
    lowest: Scalar  # N*m, smallest T
    touches: Scalar  # bool
    since: Scalar  # part of the plant step before its contact
    way: Scalar  # rad, from its start to its end


def advance_to_switch(
    p: Params,
    x: Scalar,
    v: Scalar,
    x_h: Scalar,
    e_M: Scalar,
    known: Slopes | None,
    passed: Scalar,
    last: Scalar,
    model: Model,
    dt: Scalar,
) -> Interval:
    """The motion up to the next switch, at most to the end of the plant step.

    `passed` is the part of the plant step of `dt` seconds before it. `last`: up to the end of the
    step in any case.
    """
    a = enter(p, x, v, x_h, e_M, known, model)
    left = 1.0 - passed
    path, fast = path_of(p, a, left * dt)
    end = whole(path)
    lowest, highest = _speeds(a, model)
    leaves = (end.z > a.ahead) | (end.z > a.wall) | (a.slope * end.z > a.slack)
    leaves = leaves | (end.u < lowest) | fast
    if model.divergence == "velocity_band":
        leaves = leaves | (end.u > highest)
    end = where_rare(leaves & ~last, lambda: arrival(p, a, path, fast, model), end)
    return along(p, a, path, end, left, passed, model)


def _speeds(a: Piece, model: Model) -> tuple[Scalar, Scalar]:
    """The speeds at which a piece ends, rad/s."""
    rest, unbounded = jnp.zeros_like(a.u), jnp.full_like(a.u, jnp.inf)
    if model.divergence != "velocity_band":
        return rest, unbounded
    diverging, band = a.attractor.diverging, jnp.full_like(a.u, REST_BAND)
    inside = diverging & ~a.outwards
    return jnp.where(diverging, rest, band), jnp.where(inside, band, unbounded)


def along(
    p: Params,
    a: Piece,
    path: Path,
    end: Arrival,
    left: Scalar,
    passed: Scalar,
    model: Model,
) -> Interval:
    """The motion along a piece.

    tau_env is known with its first two derivatives at both ends. So the means have order six
    (Hermite's quadrature), and an extreme between the ends is that of a parabola.
    """
    z, u, h = end.z, end.u, end.part * path.h
    tau, stiffness, work = law_at(p, a, z)
    tau_env = a.tau_env + a.Kenv * z + a.Denv * (u - a.u)
    # derivatives with the piece's duration as unit of time
    Kh, per_I = a.Kenv * h, h * (1.0 / p.I)
    c0, cc0 = end.part * path.u[1], end.part**2 * path.u[2]
    c1 = per_I * (tau - tau_env)
    r0, r1 = Kh * a.u + a.Denv * c0, Kh * u + a.Denv * c1
    cc1 = -per_I * (h * stiffness * u + r1)
    rr0, rr1 = Kh * c0 + a.Denv * cc0, Kh * c1 + a.Denv * cc1
    Td = a.s * p.Td
    g0, g1 = a.tau_env - Td, tau_env - Td
    error = 0.5 * (g0 + g1) + 0.1 * (r0 - r1) + (1.0 / 120.0) * (rr0 + rr1)
    square = (
        0.5 * (g0 * g0 + g1 * g1)
        + 0.2 * (g0 * r0 - g1 * r1)
        + (1.0 / 60.0) * (r0 * r0 + g0 * rr0 + r1 * r1 + g1 * rr1)
    )

    # An extreme is off the ends by at most |r0 - r1|/8.
    counts = (r0 * r1 < 0.0) & (jnp.abs(r0 - r1) > 8.0 * FLAT * jnp.abs(tau_env))

    def parabola() -> Scalar:
        return a.tau_env + 0.5 * r0 * r0 / jnp.where(counts, r0 - r1, 1.0)

    top = a.s * where_rare(counts, parabola, tau_env)
    T0, T1 = a.s * a.tau_env, a.s * tau_env
    x = a.x + a.s * z
    if model.contact != "welded":
        x = jnp.where(end.at_wall, p.gap, x)
    part = left * end.part
    return Interval(
        x=x,
        v=a.s * u,
        tau=a.s * tau,
        T=T1,
        attractor=a.attractor,
        part=part,
        ends_step=~end.switches,
        work=work,
        error=part * a.s * error,
        square=part * square,
        highest=jnp.where(top < T0, T0, top),
        lowest=jnp.where(top > T0, T0, top),
        touches=a.touches,
        since=passed,
        way=z,
    )


def arrival(p: Params, a: Piece, path: Path, fast: Scalar, model: Model) -> Arrival:
    """The first switch on the path of a piece, or its end."""
    z_end, u_end, one = path.way(), path.speed(), jnp.ones_like(path.h)
    lowest, highest = _speeds(a, model)
    falls = a.slope * z_end > a.slack
    slack = jnp.where(falls, a.slack, 0.0)
    limit = jnp.where(falls, slack / jnp.where(falls, a.slope, 1.0), jnp.inf)
    to = jnp.minimum(jnp.minimum(a.ahead, limit), a.wall)
    stops, rises = u_end < lowest, u_end > highest
    by_speed, passes = stops | rises, z_end > to
    level = jnp.where(rises, highest, lowest)
    way = jnp.where(passes, to, 0.0)
    rise = jnp.where(by_speed, level - a.u, way)
    rise_to = jnp.where(by_speed, u_end - a.u, z_end)
    part = root(path, by_speed, rise, rise_to, one)
    at = path.way(part)
    # the way's switch comes before the speed's
    early = by_speed & (at > to)
    way = jnp.where(early, to, way)
    none = jnp.zeros_like(early)
    part = where_rare(early, lambda: root(path, none, way, at, part), part)
    passes = early | (passes & ~by_speed)
    by_speed = by_speed & ~early
    switches = passes | by_speed
    part = jnp.where(switches, part, one)
    u = jnp.where(passes, path.speed(part), u_end)
    if model.divergence == "velocity_band":
        level = jnp.where(stops & (lowest > 0.0), INSIDE_BAND, level)
    located = Arrival(
        part=part,
        z=jnp.where(passes, way, jnp.where(by_speed, path.way(part), z_end)),
        u=jnp.where(by_speed, level, u),
        switches=switches,
        at_wall=passes & (a.wall <= to),
    )
    to = jnp.minimum(a.ahead, a.wall)
    return where_rare(fast, lambda: swept(p, a, path, fast, to), located)


def root(path: Path, of_speed: Scalar, rise: Scalar, rise_to: Scalar, until: Scalar) -> Scalar:
    """The part of the path at which speed or way has risen by `rise`; by `rise_to` at `until`.

    Newton's method from the parabola with the first slope and both ends. Only the last correction
    is differentiated: that is the implicit function theorem.
    """
    d, factorial, c = path.u, 1.0, []
    for k in range(1, len(d)):  # coefficients of the rise
        factorial /= k
        c.append(factorial * jnp.where(of_speed, d[k], path.h * d[k - 1]))

    def value(c: list[Scalar], t: Scalar) -> Scalar:
        total = c[-1]
        for term in c[-2::-1]:
            total = term + t * total
        return t * total

    def slope(c: list[Scalar], t: Scalar) -> Scalar:
        total = len(c) * c[-1]
        for k in range(len(c) - 1, 0, -1):
            total = k * c[k - 1] + t * total
        return total

    fixed, target, until = jax.lax.stop_gradient((c, rise, until))
    t = _parabola(fixed[0], target, jax.lax.stop_gradient(rise_to), until)
    for _ in range(0 if jnp.finfo(rise.dtype).bits == 32 else 2):
        t = _within(t - _quotient(value(fixed, t) - target, slope(fixed, t)), until)
    return _within(t - _quotient(value(c, t) - rise, slope(fixed, t)), until)


def _parabola(a: Scalar, rise: Scalar, rise_to: Scalar, until: Scalar) -> Scalar:
    """The t at which a t + q t^2 = `rise`, with q such that it is `rise_to` at `until`."""
    q = _quotient(rise_to - a * until, until**2)
    inside = a**2 + 4.0 * q * rise
    root = jnp.sqrt(jnp.where(inside > 0.0, inside, 0.0))
    # what has to fall, but rises first, meets the level on its way back
    back = (rise <= 0.0) & (a > 0.0)
    signed = jnp.where(rise > 0.0, root, -root)
    t = _quotient(jnp.where(back, a + root, 2.0 * rise), jnp.where(back, -2.0 * q, a + signed))
    return _within(t, until)


def _within(t: Scalar, until: Scalar) -> Scalar:
    return jnp.where(t > 0.0, jnp.where(t < until, t, until), 0.0)


def _quotient(a: Scalar, b: Scalar) -> Scalar:
    """a/b, 0 where |b| is below the smallest normal number."""
    tiny = jnp.abs(b) < jnp.finfo(b.dtype).tiny
    return jnp.where(tiny, 0.0, a / jnp.where(tiny, 1.0, b))
