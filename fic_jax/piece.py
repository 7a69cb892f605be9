"""The closed loop between two of its switches, within one plant step.

x_h, e_M and the branch are constant there, so torque and tau_env are affine in x and v, and the
motion is a Taylor series:

    I x'' = torque - tau_env = f - k x - d v

On the bend of the force profile, x0 < |e| < xb while diverging, an exponential comes in addition.
All is seen along the motion: s is its direction, z the way from the start of the piece, u = s v
the speed; the torques are s tau and s tau_env.
"""

from dataclasses import dataclass
from functools import reduce
from operator import add, mul

import jax
import jax.numpy as jnp

from fic_jax.controller import Attractor, Slopes, begin_branch, departs, torque, unlimited_torque
from fic_jax.environment import in_contact, interaction_torque
from fic_jax.exploration import expected_reference
from fic_jax.inputs import Scalar
from fic_jax.lanes.hints import where_rare
from fic_jax.params import Model, Params

# Terms of the speed's series. Four are RK4. At 10 ms the median error of nmse is 2.3e-6 with four,
# 1.3e-7 with five and 3.7e-8 with six, which take 0.05 of rk4's time more.
ORDER = 5
# rad/s: the speed that decides for a joint at rest, large enough that e v does not underflow.
SLOWEST = 1e-15


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Piece:
    """The start of a piece and its law. `torque` falls by `stiffness` per rad, or bends."""

    s: Scalar  # 1 or -1
    x: Scalar  # rad
    u: Scalar  # rad/s
    attractor: Attractor
    torque: Scalar  # N*m, limited
    stiffness: Scalar  # N*m/rad, 0 at the limit
    bends: Scalar  # bool
    outwards: Scalar  # bool: |e| grows
    ahead: Scalar  # rad to the next switch of the law
    slack: Scalar  # N*m by which the torque may fall before its limit begins or ends
    slope: Scalar  # N*m/rad, of the torque without its limit
    wall: Scalar  # rad to the environment, inf if it is not ahead
    touches: Scalar  # bool
    tau_env: Scalar  # N*m
    Kenv: Scalar  # N*m/rad, of this piece
    Denv: Scalar  # N*m*s/rad, of this piece


def enter(
    p: Params, x: Scalar, v: Scalar, x_h: Scalar, e_M: Scalar, known: Slopes | None, model: Model
) -> Piece:
    """The piece that starts at position x and velocity v, after the peak error `e_M`.

    A point just ahead lies on the piece: its torques and their derivatives are the piece's. At rest
    Algorithm 1 first diverges, with e_M = e. The acceleration that follows decides the direction,
    and so the branch.
    """
    e, rest = x_h - x, v == 0.0

    def from_rest() -> tuple[Scalar, Scalar, Scalar]:
        s = _heading(p, x, e, model)
        return s, s * SLOWEST, e

    one = jnp.ones_like(x)
    direction = jnp.where(v < 0.0, -one, one)
    s, v_soon, e_M = where_rare(rest, from_rest, (direction, v, e_M))
    s, least = jax.lax.stop_gradient((s, rounding(p)))
    e_soon, x_soon = e - s * least, x + s * least
    diverging = departs(e_soon, v_soon, model)
    attractor = begin_branch(e, diverging, e_M, p, model, known)

    tau, slope = jax.jvp(lambda e: unlimited_torque(e, attractor, p), (e_soon,), (one,))
    tau_env, Kenv = jax.jvp(lambda x: interaction_torque(x, v_soon, p, model), (x_soon,), (one,))
    _, Denv = jax.jvp(lambda v: interaction_torque(x_soon, v, p, model), (v_soon,), (one,))
    tau = s * tau + slope * least

    # A convergence from beyond xb begins at Fmax, but for rounding.
    close = 32.0 * jnp.finfo(x.dtype).eps
    above, below = tau > (1.0 + close) * p.Fmax, tau < (close - 1.0) * p.Fmax
    limited = above | below
    size, outwards = jnp.abs(e_soon), diverging
    if model.divergence == "velocity_band":  # it also diverges towards the reference
        outwards = s * e_soon <= 0.0
    bends = diverging & (size > p.x0) & (size < p.xb) & ~limited
    level = _next_level(size, outwards, diverging, below, p, model)
    wall = jnp.full_like(x, jnp.inf)
    if model.contact != "welded":
        wall = s * (p.gap - x)
        wall = jnp.where(wall > least, wall, jnp.inf)
    return Piece(
        s=s,
        x=x,
        u=s * v,
        attractor=attractor,
        torque=jnp.where(limited, jnp.where(above, p.Fmax, -p.Fmax), tau),
        stiffness=jnp.where(limited, 0.0, slope),
        bends=bends,
        outwards=outwards,
        ahead=level + s * e,
        slack=jnp.where(below | bends, jnp.inf, tau - jnp.where(above, p.Fmax, -p.Fmax)),
        slope=slope,
        wall=wall,
        touches=in_contact(x_soon, p, model),
        tau_env=s * tau_env - Kenv * least,
        Kenv=Kenv,
        Denv=Denv,
    )


def rounding(p: Params) -> Scalar:
    """Four units in the last place: so far may rounding leave the joint short of a switch, rad."""
    size = jnp.abs(expected_reference(p)) + jnp.abs(p.gap) + jnp.abs(p.x_init) + p.xb
    return 4.0 * jnp.finfo(size.dtype).eps * size


def _heading(p: Params, x: Scalar, e: Scalar, model: Model) -> Scalar:
    """The direction in which a joint at rest sets out."""
    yes, none = jnp.ones_like(e, bool), jnp.zeros_like(e)
    tau = torque(e, Attractor(yes, e, Slopes(none, none, none)), p)
    one = jnp.ones_like(e)
    return jnp.where(tau < interaction_torque(x, none, p, model), -one, one)


def _next_level(
    size: Scalar, outwards: Scalar, diverging: Scalar, below: Scalar, p: Params, model: Model
) -> Scalar:
    """The value of -s e at which the law switches next; it grows along the motion."""
    inner, beyond = size <= p.x0, size >= p.xb
    away = jnp.where(inner, p.x0, jnp.where(beyond | below, jnp.inf, p.xb))
    edge = -p.x0
    if model.divergence == "velocity_band":
        edge = jnp.where(diverging & beyond, -p.xb, edge)
    towards = jnp.where(inner, 0.0, edge)
    if model.law != "algorithm1":  # one slope
        towards = jnp.where(diverging, towards, 0.0)
    return jnp.where(outwards, away, towards)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Path:
    """The motion over `h` seconds of a piece: derivatives of the speed, with h as unit of time."""

    h: Scalar
    u: tuple[Scalar, ...]  # the speed at the start, its first derivative, ...

    def way(self, t: Scalar = 1.0) -> Scalar:
        """z at a part t of h, rad."""
        return self.h * t * _series(self.u[:-1], t, 2)

    def speed(self, t: Scalar = 1.0) -> Scalar:
        """u at a part t of h, rad/s."""
        return _series(self.u, t, 1)


def _series(d: tuple[Scalar, ...], t: Scalar, first: int) -> Scalar:
    """d0 + t/first (d1 + t/(first + 1) (d2 + ...))."""
    total = d[-1]
    for k in range(len(d) - 2, -1, -1):
        total = d[k] + t * (1.0 / (first + k)) * total
    return total


def _bend(p: Params, a: Piece) -> tuple[Scalar, Scalar, Scalar]:
    """The bend's length b (rad); 1 where |e| grows, else -1; and w (N*m) at the start of a piece.

    w = dF exp(-(|e| - x0)/b) is what the profile is short of Fmax; its slope is w/b.
    """
    b, one = (p.xb - p.x0) / p.S, jnp.ones_like(a.x)
    return b, jnp.where(a.outwards, one, -one), b * a.stiffness


def law_at(p: Params, a: Piece, z: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """s tau (N*m) and its stiffness (N*m/rad) after the way z (rad), and the work done (J)."""

    def on_bend() -> tuple[Scalar, Scalar, Scalar]:
        b, sign, w = _bend(p, a)
        way = jnp.where(a.bends, z, 0.0)  # elsewhere the exponential may overflow
        w1 = w * jnp.exp(-sign * way / b)
        return a.torque + sign * (w1 - w), w1 / b, (a.torque - sign * w) * z + b * (w - w1)

    tau = a.torque - a.stiffness * z
    affine = tau, a.stiffness, z * (0.5 * (a.torque + tau))
    return where_rare(a.bends, on_bend, affine)


def affine(p: Params, a: Piece, h: Scalar) -> Path:
    """The path of an affine piece."""
    per_I = h * (1.0 / p.I)
    K, D = h * per_I * (a.stiffness + a.Kenv), per_I * a.Denv
    d = [a.u, per_I * (a.torque - a.tau_env)]
    for _ in range(2, ORDER + 1):
        d.append(-(K * d[-2]) - D * d[-1])
    return Path(h, tuple(d))


def bent(p: Params, a: Piece, h: Scalar, fast: Scalar) -> Path:
    """The path on the bend, where the torque has a part w with w' = -+w u/b; none if `fast`."""
    b, sign, w = _bend(p, a)
    per_I, rate = h * (1.0 / p.I), sign * h / b
    w, start = jnp.where(fast, 0.0, w), jnp.where(fast, a.torque - sign * w, a.torque)
    K, D = h * per_I * a.Kenv, per_I * a.Denv
    u, ws = [a.u, per_I * (start - a.tau_env)], [w]  # coefficients of t^k
    for k in range(1, ORDER):
        product = reduce(add, map(mul, ws, u[k - 1 :: -1]))
        ws.append((-1.0 / k) * rate * product)
        u.append((1.0 / (k + 1)) * (per_I * sign * ws[k] - (1.0 / k) * K * u[k - 1] - D * u[k]))
    factorial = 1.0
    for k in range(2, ORDER + 1):
        factorial *= k
        u[k] = factorial * u[k]
    return Path(h, tuple(u))


def path_of(p: Params, a: Piece, h: Scalar) -> tuple[Path, Scalar]:
    """The path of a piece over h seconds, and whether it is too `fast` on the bend for a series.

    The path then leaves out the bend's w.
    """

    def on_bend() -> tuple[Path, Scalar]:
        fast = a.u * h * p.S > p.xb - p.x0
        return bent(p, a, h, fast), fast

    return where_rare(a.bends, on_bend, (affine(p, a, h), jnp.zeros_like(a.bends)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Arrival:
    """Where a piece is left."""

    part: Scalar  # of the duration of its path
    z: Scalar  # rad
    u: Scalar  # rad/s
    switches: Scalar  # bool: at a switch, not at the end of the plant step
    at_wall: Scalar  # bool: at that of the environment


def whole(path: Path) -> Arrival:
    """The end of a path without a switch."""
    z, no = path.way(), jnp.zeros_like(path.h, bool)
    return Arrival(jnp.ones_like(z), z, path.speed(), no, no)


def swept(p: Params, a: Piece, path: Path, fast: Scalar, to: Scalar) -> Arrival:
    """The end of a `fast` piece on the bend, at most at z = `to`.

    The bend takes its energy b (w - w1) at once, while the speed hardly changes: so z is the
    independent variable of an RK4 step for the other torques' work and for the time.
    """
    b, sign, w = _bend(p, a)
    # of another piece, numbers that make no infinite gradient
    w = jnp.where(fast, w, 0.0)
    start, guess = jnp.where(fast, a.u, 1.0), jnp.where(fast, path.way(), 0.0)
    reaches = guess >= to
    z = jnp.where(reaches & fast, to, guess)
    per_I = 2.0 / p.I
    least = (0.1 * start) ** 2

    def speed(part: float, taken: Scalar) -> Scalar:
        """At a part of z, with `taken` from u^2 by the environment."""
        way = part * z
        bend = b * w * (1.0 - jnp.exp(-sign * way / b))
        square = start**2 + per_I * ((a.torque - sign * w) * way + bend) - taken
        return jnp.sqrt(jnp.where(square > least, square, least))

    def rates(part: float, taken: Scalar) -> tuple[Scalar, Scalar]:
        u = speed(part, taken)
        tau_env = a.tau_env + a.Kenv * part * z + a.Denv * (u - start)
        return z * per_I * tau_env, z / u

    k1 = rates(0.0, jnp.zeros_like(z))
    k2 = rates(0.5, 0.5 * k1[0])
    k3 = rates(0.5, 0.5 * k2[0])
    k4 = rates(1.0, k3[0])
    stages = zip(k1, k2, k3, k4, strict=True)
    taken, time = ((c1 + 2.0 * c2 + 2.0 * c3 + c4) * (1.0 / 6.0) for c1, c2, c3, c4 in stages)
    u = speed(1.0, taken)
    tau = a.torque + sign * w * (jnp.exp(-sign * z / b) - 1.0)
    change = (tau - a.tau_env - a.Kenv * z - a.Denv * (u - start)) / p.I
    late = jnp.where(reaches, 0.0, path.h - time)  # the guess was not exact
    part = time / jnp.where(reaches & fast, path.h, 1.0)
    return Arrival(
        part=jnp.where(reaches, jnp.minimum(part, 1.0), 1.0),
        z=z + late * (u + 0.5 * late * change),
        u=u + late * change,
        switches=reaches,
        at_wall=reaches & (a.wall <= a.ahead),
    )
