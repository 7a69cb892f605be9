"""The default model in numba: one scenario at a time, its whole run in scalars."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from benchmarks.peers import installed

numba = installed("numba")
F = TypeVar("F", bound=Callable[..., Any])

# What may be rearranged without harm: not `reassoc`, which would undo the compensated sums, and
# not `nnan` or `ninf`, since a run may leave the finite numbers.
FASTMATH = {"contract", "arcp", "nsz"}
LATEST = 1.0 - 0.05  # part of the run at which a torque may converge last


def jit(function: F) -> F:
    """Compile one scalar function; keep the result on disk."""
    return numba.njit(fastmath=FASTMATH, cache=True, error_model="numpy")(function)


class Law(NamedTuple):
    """One scenario's parameters, in the order of Params."""

    K0: Any
    Fmax: Any
    x0: Any
    xb: Any
    S: Any
    Td: Any
    xd: Any
    sigma: Any
    period: Any
    I: Any  # noqa: E741  the paper's symbol
    Kenv: Any
    Denv: Any
    gap: Any
    x_init: Any
    v_init: Any


class Numbers(NamedTuple):
    """Constants in the dtype of the run: a literal would turn float32 into float64."""

    dt: Any
    zero: Any
    half: Any
    one: Any
    two: Any
    four: Any
    six: Any
    band: Any
    ulps: Any  # four units in the last place, relative
    inf: Any


@jit
def decay(size: Any, p: Law) -> Any:
    """exp(-(|e| - x0)/b), for |e| between x0 and xb."""
    return math.exp(-(size - p.x0) * (p.S / (p.xb - p.x0)))


@jit
def spring(e: Any, p: Law) -> Any:
    """F_K of eq. 1."""
    size = abs(e)
    if size < p.x0:
        return p.K0 * e
    magnitude = p.Fmax
    if size < p.xb:
        magnitude = p.Fmax - (p.Fmax - p.K0 * p.x0) * decay(size, p)
    return math.copysign(magnitude, e)


@jit
def energy(e: Any, p: Law, c: Numbers) -> Any:
    """E_K of eq. 2 for |e| >= x0."""
    size = abs(e)
    b = (p.xb - p.x0) / p.S
    curved = b * (p.Fmax - p.K0 * p.x0) * (c.one - decay(min(size, p.xb), p))
    return p.Fmax * (size - p.x0) + c.half * p.K0 * p.x0 * p.x0 - curved


@jit
def torque(e: Any, diverging: bool, e_M: Any, near: Any, far: Any, p: Law, c: Numbers) -> Any:
    """Algorithm 1, with the slopes `near` (|e| <= x0) and `far` of its converging branch."""
    if diverging:
        t = spring(e, p)
    else:
        t = (near if abs(e) <= p.x0 else far) * (e - c.half * e_M)
    if t > p.Fmax:
        return p.Fmax
    if t < -p.Fmax:
        return -p.Fmax
    return t


@jit
def interaction(x: Any, v: Any, p: Law, c: Numbers) -> Any:
    """The hard stop."""
    if x >= p.gap:
        return p.Kenv * (x - p.gap) + p.Denv * (c.zero if v < c.zero else v)
    return c.zero


@jit
def plus(total: Any, excess: Any, value: Any) -> Any:
    """A compensated sum with one more term."""
    term = value - excess
    summed = total + term
    return summed, (summed - total) - term


@jit
def scenario(  # noqa: PLR0915  one loop, so that the state stays in registers
    p: Law, c: Numbers, n_steps: int, reals: np.ndarray, counts: np.ndarray
) -> None:
    """Simulate one scenario and write its metrics."""
    h, h_2, h_6, sixth = c.dt, c.half * c.dt, c.dt / c.six, c.one / c.six
    x, v = p.x_init, p.v_init
    tau_env = interaction(x, v, p, c)
    x_h = expected = p.xd + p.Td / p.K0
    search, ticks_every = p.sigma / p.K0, max(round(p.period / c.dt), 1)
    T_n = math.copysign(min(abs(p.Td), p.Fmax), p.Td)
    per_T_n, per_I = c.one / T_n, c.one / p.I
    rest = c.ulps * (abs(expected) + abs(p.gap) + abs(p.x_init) + p.xb) * (h / p.period)
    e_M, near, far = x_h - x, c.zero, c.zero
    countdown, diverging = 0, True
    head = square = square_x = error = error_x = work = work_x = c.zero
    highest, apart = tau_env, tau_env * per_T_n - c.one
    settled = c.zero if abs(apart) <= c.band else c.inf
    touched = 0 if x >= p.gap else n_steps + 1
    in_contact, switches, branch = 0, -1, -1  # the first branch differs from -1, which is none
    for k in range(n_steps):
        if k == n_steps // 2:
            head = square
            square = square_x = error = error_x = c.zero
        if countdown <= 0:
            countdown = ticks_every
            if tau_env != p.Td:
                x_h = expected if abs(x) <= abs(p.xd) else x_h + search * (p.Td - tau_env)
        countdown -= 1
        e = x_h - x
        was, diverging = diverging, e * v <= c.zero
        if diverging:
            e_M = e
        elif was:  # e_M is held from here on, and with it the slopes
            near = far = c.two * p.K0
            if abs(e_M) > p.x0:
                near = c.four * energy(e_M, p, c) / (e_M * e_M)
                far = c.two * spring(e_M, p) / e_M
        t1 = torque(e, diverging, e_M, near, far, p, c)
        e1, a1 = tau_env - p.Td, (t1 - tau_env) * per_I
        x2, v2 = x + h_2 * v, v + h_2 * a1
        t2, tau_env = torque(x_h - x2, diverging, e_M, near, far, p, c), interaction(x2, v2, p, c)
        e2, a2 = tau_env - p.Td, (t2 - tau_env) * per_I
        x3, v3 = x + h_2 * v2, v + h_2 * a2
        t3, tau_env = torque(x_h - x3, diverging, e_M, near, far, p, c), interaction(x3, v3, p, c)
        e3, a3 = tau_env - p.Td, (t3 - tau_env) * per_I
        x4, v4 = x + h * v3, v + h * a3
        t4, tau_env = torque(x_h - x4, diverging, e_M, near, far, p, c), interaction(x4, v4, p, c)
        e4, a4 = tau_env - p.Td, (t4 - tau_env) * per_I
        # the integrals are states of the same step; error and square are means over it
        done = h_6 * (t1 * v + c.two * (t2 * v2 + t3 * v3) + t4 * v4)
        work, work_x = plus(work, work_x, done)
        error, error_x = plus(error, error_x, sixth * (e1 + c.two * (e2 + e3) + e4))
        squares = e1 * e1 + c.two * (e2 * e2 + e3 * e3) + e4 * e4
        square, square_x = plus(square, square_x, sixth * squares)
        x_before = x
        x += h_6 * (v + c.two * (v2 + v3) + v4)
        v += h_6 * (a1 + c.two * (a2 + a3) + a4)
        # the sample at the end of the step
        tau_env = interaction(x, v, p, c)
        before, apart = apart, tau_env * per_T_n - c.one
        if not abs(apart) <= c.band:  # NaN counts as outside
            settled = c.inf
        elif settled == c.inf:  # on a line between the two samples
            way = before - math.copysign(c.band, before)
            settled = reals.dtype.type(k) + (way / (before - apart) if before != apart else way)
        if tau_env > highest:  # noqa: PLR1730  passes over a NaN, as `larger` does
            highest = tau_env
        if x >= p.gap:
            in_contact += 1
            touched = min(touched, k + 1)  # the end of its step
        # a joint that moves by less rests: its branch is the sign of rounding errors
        if abs(x - x_before) > rest and branch != diverging:
            branch = int(diverging)
            switches += 1
    n_tail = n_steps - n_steps // 2
    per_square = per_T_n * per_T_n
    nmse = (head + square) / n_steps * per_square
    above = highest * per_T_n - c.one
    lost = max(n_steps - touched - in_contact, 0)
    reals[0] = nmse
    reals[1] = square / n_tail * per_square
    reals[2] = settled * h if settled <= LATEST * n_steps else c.inf
    reals[3] = error / n_tail * per_T_n
    reals[4] = highest
    reals[5] = above if T_n > c.zero and above > c.zero else c.zero
    reals[6] = reals.dtype.type(touched) * h if touched <= n_steps else c.inf
    reals[7] = reals.dtype.type(lost) * h
    reals[8] = work
    counts[0] = max(switches, 0)
    finite = math.isfinite(x) and math.isfinite(v) and math.isfinite(nmse) and math.isfinite(work)
    counts[1] = 1 if finite else 0


def _run(
    columns: np.ndarray, c: Numbers, n_steps: int, reals: np.ndarray, counts: np.ndarray
) -> None:
    """Every scenario: columns [N, field] to reals [N, 9] and counts [N, 2]."""
    for i in numba.prange(len(columns)):
        q = columns[i]
        p = Law(
            q[0], q[1], q[2], q[3], q[4], q[5], q[6], q[7], q[8], q[9], q[10], q[11], q[12], q[13],
            q[14],
        )  # fmt: skip
        scenario(p, c, n_steps, reals[i], counts[i])


run = numba.njit(parallel=True, fastmath=FASTMATH, cache=True, error_model="numpy")(_run)
