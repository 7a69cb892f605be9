"""The closed loop linearised on one branch: Algorithm 2 sampled, the joint between two ticks exact.

While the joint converges and its peak error e_M is constant, torque, environment and search are
linear in (x, v, x_h), and one period is one matrix:

    y(k+1) = Phi J y(k),   y = (x, v, x_h, 1)

with J the tick of Algorithm 2 and Phi = exp(A period) the motion until the next one. A and J are
derivatives of the physics' own functions: no equation is written a second time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Loop:
    """Loops of N scenarios on one branch of the controller."""

    motion: Any  # [N, 4, 4], A of d(x, v, x_h, 1)/dt
    tick: Any  # [N, 4, 4], J
    torque: Any  # [N, 4], tau_env as a row on (x, v, x_h, 1)
    start: Any  # [N, 4]
    period: Any  # [N], s
    Td: Any  # [N], N*m

    def spectral_radius(self) -> Floats:
        """Largest |eigenvalue| of one period on (x, v, x_h); beyond 1 the loop is unstable."""
        whole = self.after(self.period) @ self.tick
        return np.asarray(np.abs(np.linalg.eigvals(whole[:, :3, :3])).max(axis=1))

    def after(self, seconds: Floats) -> Floats:
        """exp(A t) of each scenario's time."""
        return np.asarray(expm(self.motion * seconds[:, None, None]))


def starting(p: Params) -> Loop:
    """The converging loop the joint starts in: at rest at x_init with e_M = Td/K0 + xd - x_init."""
    return _linearised(p, "start")


def resting(p: Params, branch: Literal["diverging", "converging"]) -> Loop:
    """The loop about rest at T = Td, `diverging` (slope dF_K/de) or `converging` (2 F_K/e).

    The error at rest is the one with F_K(e) = Td, below xb.
    """
    return _linearised(p, branch)


def first_branch(p: Params) -> tuple[Floats, Floats, Floats]:
    """The converging branch met first: excess r = F_K(e_M)/Td and its two slopes, N*m/rad.

    e_M = Td/K0 + xd - x_init is the error the joint starts at; the slopes are 2 F_K(e_M)/e_M, of
    errors beyond x0, and 4 E_K(e_M)/e_M^2.
    """
    with jax.enable_x64(True):
        excess, effort, energy = _first_branch(_columns(p))
    return np.asarray(excess), np.asarray(effort), np.asarray(energy)


@jax.jit
@jax.vmap
def _first_branch(p: Params) -> tuple[jax.Array, ...]:
    e_M = expected_reference(p) - p.x_init
    slopes = converging_slopes(e_M, p, Model(law="algorithm1"))
    return force(e_M, p) / p.Td, slopes.outer, slopes.inner


def _columns(p: Params) -> Params:
    """Params with [N] leaves in double precision."""
    columns = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, float)) for v in vars(p).values()))
    return canonical(Params(*columns))


def _linearised(p: Params, branch: str) -> Loop:
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _loops(_columns(p), branch))


@partial(jax.jit, static_argnames="branch")
def _loops(p: Params, branch: str) -> Loop:
    return jax.vmap(partial(_one, branch=branch))(p)


def _one(p: Params, branch: str) -> Loop:
    x_h = expected_reference(p)
    e_M = x_h - p.x_init if branch == "start" else _error_at_rest(p)
    attractor = begin_branch(e_M, jnp.asarray(branch == "diverging"), e_M, p, LINEAR)
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
        x_h, _ = explore(
            y[2], jnp.zeros((), jnp.int32), past_contact, touch(y), p, LINEAR, p.period
        )
        return jnp.stack([y[0], y[1], x_h])

    def square(f: Callable[[jax.Array], jax.Array], corner: float) -> jax.Array:
        return jnp.concatenate([_affine(f, at), jnp.zeros((1, 4)).at[0, 3].set(corner)])

    row = _affine(lambda y: touch(y)[None], at)[0]
    start = jnp.stack([x_h - e_M, jnp.zeros_like(e), x_h, jnp.ones_like(e)])
    return Loop(square(motion, 0.0), square(tick, 1.0), row, start, p.period, p.Td)


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


def response(loop: Loop, t_end: float) -> tuple[Flags, Floats]:
    """Whether v turns negative within t_end, and nmse over the second half (Td < Fmax)."""
    looks = np.clip(np.ceil(loop.period / LOOK), 1, None).astype(int)  # in one period
    total = looks * np.round(t_end / loop.period).astype(int)
    with jax.enable_x64(True):
        turns, square = _followed(loop, loop.after(loop.period / looks), looks, total)
    return np.asarray(turns), np.asarray(square) / (total - total // 2)


@jax.jit
def _followed(
    loop: Loop, between: jax.Array, looks: jax.Array, total: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Whether v turns, and the sum of the squared torque errors of the second half."""

    def body(i: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        y, turns, square = carry
        # the first tick sets x_h to xd + Td/K0, where it is
        ticks = (i % looks == 0) & (i > 0)
        y = jnp.where(ticks[:, None], jnp.einsum("nij,nj->ni", loop.tick, y), y)
        y = jnp.einsum("nij,nj->ni", between, y)
        eps = (loop.torque * y).sum(axis=1) / loop.Td - 1.0
        tail = (i >= total // 2) & (i < total)
        turns = turns | ((i < total) & ~(y[:, 1] >= TURN))
        return y, turns, square + jnp.where(tail, eps**2, 0.0)

    begin = (loop.start, jnp.zeros(loop.Td.shape, bool), jnp.zeros_like(loop.Td))
    _, turns, square = jax.lax.fori_loop(0, total.max(), body, begin)
    return turns, square
