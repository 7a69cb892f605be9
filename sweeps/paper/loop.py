"""The closed loop linearised on one branch: Algorithm 2 sampled, the joint between two ticks exact.

While the joint converges with its peak error e_M held, torque, environment and search are linear in
(x, v, x_h), and one period is one matrix:

    y(k+1) = Phi J y(k),   y = (x, v, x_h, 1)

with J the tick of Algorithm 2 and Phi = exp(A period) the motion until the next one. A and J are
derivatives of the physics' own functions, so that no equation stands here a second time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import expm
from numpy.typing import NDArray

from fic_jax import Model, Params
from fic_jax.controller import begin_branch, converging_slopes, torque
from fic_jax.environment import interaction_torque
from fic_jax.exploration import expected_reference, explore
from fic_jax.params import canonical
from fic_jax.profile import force
from fic_jax.rk4 import net_torque

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# One law with one slope, and damping both ways: what a converging joint sees of all of them
LINEAR = Model(law="effort", contact="welded")
TURN = -1e-9  # rad/s; rounding leaves a joint at rest less than this
LOOK = 0.005  # s, between two looks at the motion; a twentieth of I/Denv and less


@dataclass(frozen=True)
class Loop:
    """Loops of N scenarios on one branch of the controller."""

    motion: Floats  # [N, 4, 4], A of d(x, v, x_h, 1)/dt
    tick: Floats  # [N, 4, 4], J
    torque: Floats  # [N, 4], tau_env as a row on (x, v, x_h, 1)
    start: Floats  # [N, 4]
    period: Floats  # [N], s
    Td: Floats  # [N], N*m

    def monodromy(self) -> Floats:
        """The matrix of one period, from tick to tick, on (x, v, x_h)."""
        whole = propagator(self.motion, self.period) @ self.tick
        return whole[:, :3, :3]

    def spectral_radius(self) -> Floats:
        """Largest |eigenvalue| of one period; beyond 1 the loop is unstable."""
        return np.asarray(np.abs(np.linalg.eigvals(self.monodromy())).max(axis=1))


def propagator(motion: Floats, seconds: Floats) -> Floats:
    """exp(A t) of [N] matrices and times."""
    with jax.enable_x64(True):
        return np.asarray(_propagator(motion, seconds))


@jax.jit
def _propagator(motion: jax.Array, seconds: jax.Array) -> jax.Array:
    return jax.vmap(lambda A, t: expm(A * t))(motion, seconds)


def starting(p: Params) -> Loop:
    """The converging loop the joint starts in: at rest at x_init with e_M = Td/K0 + xd - x_init."""
    return _loops(p, branch="start")


def first_branch(p: Params) -> tuple[Floats, Floats, Floats]:
    """The converging branch met first: excess r = F_K(e_M)/Td and its two slopes, N*m/rad.

    e_M = Td/K0 + xd - x_init is the error the joint starts at; the slopes are 2 F_K(e_M)/e_M, of
    errors beyond x0, and 4 E_K(e_M)/e_M^2.
    """
    with jax.enable_x64(True):
        excess, effort, energy = _first_branch(_columns(p))
    return np.asarray(excess), np.asarray(effort), np.asarray(energy)


@jax.jit
def _first_branch(batch: Params) -> tuple[jax.Array, jax.Array, jax.Array]:
    def one(p: Params) -> tuple[jax.Array, jax.Array, jax.Array]:
        e_M = expected_reference(p) - p.x_init
        slopes = converging_slopes(e_M, p, Model(law="algorithm1"))
        return force(e_M, p) / p.Td, slopes.outer, slopes.inner

    return jax.vmap(one)(batch)


def resting(p: Params, branch: str) -> Loop:
    """The loop about rest at T = Td, `diverging` (slope dF_K/de) or `converging` (2 F_K/e).

    The error at rest is the one with F_K(e) = Td, below xb.
    """
    return _loops(p, branch=branch)


def _loops(p: Params, branch: str) -> Loop:
    with jax.enable_x64(True):
        batch = _columns(p)
        motion, tick, row, start = (np.asarray(part) for part in _linearised(batch, branch))
    return Loop(motion, tick, row, start, np.asarray(batch.period), np.asarray(batch.Td))


def _columns(p: Params) -> Params:
    """Params with [N] leaves in double precision."""
    columns = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, float)) for v in vars(p).values()))
    return canonical(Params(*columns))


@partial(jax.jit, static_argnames="branch")
def _linearised(batch: Params, branch: str) -> tuple[jax.Array, ...]:
    return jax.vmap(partial(_one, branch=branch))(batch)


def _one(p: Params, branch: str) -> tuple[jax.Array, ...]:
    x_h = expected_reference(p)
    e_M = x_h - p.x_init if branch == "start" else _error_at_rest(p)
    attractor = begin_branch(e_M, jnp.asarray(True), e_M, p, LINEAR)
    attractor = replace(attractor, diverging=jnp.asarray(branch == "diverging"))
    # Where the torque is short of Fmax: the converging branch is linear, any such error will do.
    e = e_M if branch == "diverging" else 0.75 * e_M
    at = jnp.stack([x_h - e, jnp.zeros_like(e), x_h])

    def motion(y: jax.Array) -> jax.Array:
        x, v, x_h = y
        tau = torque(x_h - x, attractor, p)
        return jnp.stack([v, net_torque(p, tau, x, v, LINEAR) / p.I, jnp.zeros_like(v)])

    def touch(y: jax.Array) -> jax.Array:
        return interaction_torque(y[0], y[1], p, LINEAR)

    def tick(y: jax.Array) -> jax.Array:
        past_contact = jnp.abs(p.xd) + 1.0  # where Algorithm 2 searches
        x_h, _ = explore(y[2], jnp.zeros((), jnp.int32), past_contact, touch(y), p, p.period)
        return jnp.stack([y[0], y[1], x_h])

    row = _affine(lambda y: touch(y)[None], at)[0]
    start = jnp.stack([x_h - e_M, jnp.zeros_like(e), x_h, jnp.ones_like(e)])
    return _square(_affine(motion, at), 0.0), _square(_affine(tick, at), 1.0), row, start


def _error_at_rest(p: Params) -> jax.Array:
    """The error with F_K(e) = Td, by bisection between 0 and xb."""

    def halved(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        middle = 0.5 * (ends[0] + ends[1])
        short = force(middle, p) < p.Td
        return jnp.where(short, middle, ends[0]), jnp.where(short, ends[1], middle)

    low, high = jax.lax.fori_loop(0, 60, halved, (jnp.zeros_like(p.xb), p.xb))
    return 0.5 * (low + high)


def _affine(f: Callable[[jax.Array], jax.Array], at: jax.Array) -> jax.Array:
    """f near `at` as a matrix on (y, 1)."""
    slope = jax.jacfwd(f)(at)
    return jnp.column_stack([slope, f(at) - slope @ at])


def _square(rows: jax.Array, corner: float) -> jax.Array:
    return jnp.concatenate([rows, jnp.zeros((1, 4)).at[0, 3].set(corner)])


def response(loop: Loop, t_end: float) -> tuple[Flags, Floats]:
    """Whether v turns negative within t_end, and nmse over the second half (Td < Fmax)."""
    looks = np.clip(np.ceil(loop.period / LOOK), 1, None).astype(int)  # in one period
    between = propagator(loop.motion, loop.period / looks)
    ticks = np.round(t_end / loop.period).astype(int)
    with jax.enable_x64(True):
        ends = (looks, looks * ticks)
        turns, square = _followed(loop.start, loop.tick, between, loop.torque, loop.Td, *ends)
    return np.asarray(turns), np.asarray(square) / (ends[1] - ends[1] // 2)


@jax.jit
def _followed(
    start: jax.Array,
    tick: jax.Array,
    between: jax.Array,
    row: jax.Array,
    Td: jax.Array,
    looks: jax.Array,
    total: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    def body(i: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        y, turns, square = carry
        # the first tick sets x_h to xd + Td/K0, where it is
        ticks = (i % looks == 0) & (i > 0)
        y = jnp.where(ticks[:, None], jnp.einsum("nij,nj->ni", tick, y), y)
        y = jnp.einsum("nij,nj->ni", between, y)
        eps = (row * y).sum(axis=1) / Td - 1.0
        tail = (i >= total // 2) & (i < total)
        turns = turns | ((i < total) & ~(y[:, 1] >= TURN))
        return y, turns, square + jnp.where(tail, eps**2, 0.0)

    begin = (start, jnp.zeros(Td.shape, bool), jnp.zeros_like(Td))
    _, turns, square = jax.lax.fori_loop(0, total.max(), body, begin)
    return turns, square
