"""Metrics of the motion, summed step by step: no trajectory is stored.

T is the interaction torque tau_env, T_n = sgn(Td) min(|Td|, Fmax) the reachable torque, and
eps = (T - Td)/T_n. The tail is the second half of the run. To add a metric: docs/architecture.md.
"""

import dataclasses
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax.display import Displayed, Table, row
from fic_jax.environment import in_contact, interaction_torque
from fic_jax.events import Interval
from fic_jax.inputs import Scalar, transferred
from fic_jax.lanes.hints import where_rare
from fic_jax.params import Model, Params
from fic_jax.piece import rounding
from fic_jax.simulation import Progress, checked, initial, plant_step, step_to_switch, with_slopes

SETTLING_BAND = 0.05  # the torque has converged while |T/T_n - 1| is at most this
SETTLED_PART = 0.05  # of the run, at least, that a torque which has converged stays in the band


def _metric(unit: str, meaning: str) -> Any:
    return field(metadata={"unit": unit, "meaning": meaning})


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Metrics(Displayed):
    """The metrics of one scenario (scalars) or of N ([N] leaves); METRICS has their units."""

    nmse: Scalar = _metric("1", "normalised mean square torque error, whole run")
    nmse_tail: Scalar = _metric("1", "normalised mean square torque error, second half")
    convergence_time: Scalar = _metric(
        "s", "time from which the torque stays within 5 % of min(|Td|, Fmax)"
    )
    steady_error: Scalar = _metric("1", "mean normalised torque error, second half")
    peak_torque: Scalar = _metric("N*m", "largest interaction torque")
    overshoot: Scalar = _metric("1", "largest torque over the reachable one, less 1")
    contact_time: Scalar = _metric("s", "time of first contact")
    contact_lost: Scalar = _metric("s", "time out of contact after the first touch")
    mode_switches: Scalar = _metric("1", "switches between divergence and convergence")
    energy_in: Scalar = _metric("J", "work done by the controller")
    finite: Scalar = _metric("1", "1 if the run stayed within the finite numbers")

    def _table(self) -> Table:
        return Table("Metrics", [row(n, value, METRICS[n]) for n, value in vars(self).items()])


METRICS = {f.name: f.metadata for f in dataclasses.fields(Metrics)}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sum:
    """A compensated sum (Kahan 1965); 10^6 plain float32 additions lose 1 % of an nmse."""

    total: Scalar
    excess: Scalar  # the rounding error in `total`

    def plus(self, value: Scalar) -> "Sum":
        """The sum with one more term."""
        term = value - self.excess
        total = self.total + term
        return Sum(total, (total - self.total) - term)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Accumulator:
    """Running sums and extremes of one scenario. Instants and durations are in plant steps."""

    square_head: Scalar  # sum of `square` over the first half, 0 before the second begins
    square: Sum  # of each step's mean of (T - Td)^2, (N*m)^2, over the current half
    error: Sum  # of each step's mean of T - Td, N*m, over the current half
    work: Sum  # J
    settled: Scalar  # instant from which T is in the settling band, inf while it is outside
    T: Scalar  # N*m, of the last sample
    highest: Scalar  # N*m, largest T
    lowest: Scalar  # N*m, smallest T, at most 0; always 0 at a hard stop, which does not pull
    touched: Scalar  # instant of the first touch, inf before
    contact: Sum  # duration of contact
    switches: Scalar  # of the branch, so far
    branch: Scalar  # int32, 1 if diverging


def reachable(p: Params) -> jax.Array:
    """The reachable torque T_n = sgn(Td) min(|Td|, Fmax), N*m; eps is in units of it."""
    return jnp.sign(p.Td) * jnp.minimum(jnp.abs(p.Td), p.Fmax)


def deviation(T: Scalar, p: Params) -> jax.Array:
    """T/T_n - 1: the torque has converged while its size is at most SETTLING_BAND."""
    return T * (1.0 / reachable(p)) - 1.0


def empty(p: Params, model: Model) -> Accumulator:
    """The accumulator of the initial state."""
    zero, never = jnp.zeros_like(p.Td), jnp.full_like(p.Td, jnp.inf)
    sum_ = Sum(zero, zero)
    T = interaction_torque(p.x_init, p.v_init, p, model)
    return Accumulator(
        square_head=zero,
        square=sum_,
        error=sum_,
        work=sum_,
        settled=jnp.where(jnp.abs(deviation(T, p)) <= SETTLING_BAND, zero, never),
        T=T,
        highest=jnp.maximum(T, zero),
        lowest=jnp.minimum(T, zero),
        touched=jnp.where(in_contact(p.x_init, p, model), zero, never),
        contact=sum_,
        # the first branch is another one than -1, and counts as a switch
        switches=jnp.full_like(p.Td, -1, jnp.int32),
        branch=jnp.full_like(p.Td, -1, jnp.int32),
    )


def begin_tail(acc: Accumulator) -> Accumulator:
    """The accumulator where the second half begins: its sums start from zero."""
    none = Sum(jnp.zeros_like(acc.square.total), jnp.zeros_like(acc.square.excess))
    return dataclasses.replace(acc, square_head=acc.square.total, square=none, error=none)


def larger(a: Scalar, b: Scalar) -> jax.Array:
    """The larger number; the first if one is NaN, which `jnp.maximum` looks for at some cost."""
    return jnp.where(b > a, b, a)


def update(
    acc: Accumulator, interval: Interval, k: Scalar, rest: Scalar, p: Params, model: Model
) -> Accumulator:
    """Add an interval of plant step k (counted from 0).

    A joint that moves by less than `rest` (rad) in a plant step counts as at rest: its branch is
    the sign of rounding errors.
    """
    ends, T, at = interval.ends_step, interval.T, jnp.asarray(k, acc.T.dtype)
    far, last = deviation(T, p), acc.settled
    inside = jnp.abs(far) <= SETTLING_BAND  # false for NaN

    enters = inside & ends & (last == jnp.inf)  # samples are the ends of plant steps

    def entry() -> jax.Array:
        """When T, between two samples on a line, enters the band."""
        before = deviation(acc.T, p)
        way = before - SETTLING_BAND * jnp.sign(before)
        return at + way / jnp.where(enters, before - far, 1.0)

    settled = where_rare(enters, entry, last)
    first = acc.touched == jnp.inf
    touches, counts = first & interval.touches, interval.touches
    if model.integrator == "rk4":  # a touch is seen at the end of its step
        counts = counts & ~first
    pulls = model.contact != "hard_stop"
    diverging = interval.attractor.diverging.astype(jnp.int32)
    branch = jnp.where(interval.way > rest * interval.part, diverging, acc.branch)
    return Accumulator(
        square_head=acc.square_head,
        square=acc.square.plus(interval.square),
        error=acc.error.plus(interval.error),
        work=acc.work.plus(interval.work),
        settled=jnp.where(ends & ~inside, jnp.inf, settled),
        T=jnp.where(ends, T, acc.T),
        highest=larger(acc.highest, interval.highest),
        lowest=-larger(-acc.lowest, -interval.lowest) if pulls else acc.lowest,
        touched=jnp.where(touches, at + interval.since, acc.touched),
        contact=acc.contact.plus(jnp.where(counts, interval.part, 0.0)),
        switches=acc.switches + (branch != acc.branch).astype(jnp.int32),
        branch=branch,
    )


def finish(
    acc: Accumulator, x: Scalar, v: Scalar, n_steps: int, tail: int, p: Params, h: jax.Array
) -> Metrics:
    """Metrics from the sums over `n_steps` plant steps of h seconds; inf means "does not happen".

    `x` and `v` are the last sample's: once they are infinite or NaN they remain so.
    """
    n_tail = n_steps - tail
    T_n = reachable(p)
    per_T_n = 1.0 / T_n
    nmse = (acc.square_head + acc.square.total) / n_steps * per_T_n**2
    converged = acc.settled <= (1.0 - SETTLED_PART) * n_steps
    touched = acc.touched < jnp.inf
    lost = n_steps - jnp.where(touched, acc.touched, n_steps) - acc.contact.total
    return Metrics(
        nmse=nmse,
        nmse_tail=acc.square.total / n_tail * per_T_n**2,
        convergence_time=jnp.where(converged, jnp.where(converged, acc.settled, 0.0) * h, jnp.inf),
        steady_error=acc.error.total / n_tail * per_T_n,
        peak_torque=jnp.abs(jnp.maximum(acc.highest, -acc.lowest)),  # abs: the larger may be -0
        overshoot=jnp.maximum(jnp.where(T_n < 0.0, acc.lowest, acc.highest) * per_T_n - 1.0, 0.0),
        contact_time=acc.touched * h,
        contact_lost=jnp.maximum(lost, 0.0) * h,
        mode_switches=jnp.maximum(acc.switches, 0),
        energy_in=acc.work.total,
        finite=jnp.isfinite(x)
        & jnp.isfinite(v)
        & jnp.isfinite(nmse)
        & jnp.isfinite(acc.work.total),
    )


def blank(p: Params, dt: Scalar) -> Metrics:
    """Metrics without a run, for their types."""
    return finish(empty(p, Model()), p.x_init, p.v_init, 2, 1, p, dt)


def evaluate(params: Params, *, model: Model = Model(), dt: Scalar, n_steps: int) -> Metrics:
    """Metrics of one scenario over `n_steps` plant steps of `dt` seconds; no sample is stored.

    Takes Params with scalar leaves; returns Metrics with scalar leaves. vmap, grad and the caller's
    jit apply. Take gradients with `rk4_events`: the derivative of an rk4 run is wrong where contact
    is made or lost.

    Raises ParamsError if a value is out of bounds. Values under the caller's jit or vmap are not
    checked.
    """
    p, dt, n_steps = checked(params, dt, n_steps, model)
    return transferred(compiled_evaluate, p, dt, model=model, n_steps=n_steps)


Run = tuple[Metrics, Scalar]  # the metrics of a run, and T at its end, N*m


@partial(jax.jit, static_argnames=("model", "n_steps"))
def compiled_evaluate(p: Params, dt: jax.Array, model: Model, n_steps: int) -> Metrics:
    """`evaluate` on canonical numbers."""
    return run_by_steps(p, model, dt, n_steps)[0]


def run_by_steps(
    p: Params,
    model: Model,
    dt: jax.Array,
    n_steps: int,
    finer: int = 1,
    coarse: float = 1.0,
    unroll: int = 1,
) -> Run:
    """A differentiable run with each step in `finer` parts, `unroll` of them in an iteration.

    In a control period a joint at rest moves by at most `coarse` times the rounding of positions.
    """
    h, n, tail = dt / finer, finer * n_steps, finer * (n_steps // 2)
    rest = coarse * rounding(p) * (h / p.period)

    def body(k: jax.Array, carry: Any) -> Any:
        state, acc = carry
        acc = where_rare(k == tail, lambda: begin_tail(acc), acc)

        def see(acc: Accumulator, interval: Interval) -> Accumulator:
            return update(acc, interval, k, rest, p, model)

        return plant_step(p, state, model, h, see, acc)

    start = (with_slopes(p, initial(p, model)), empty(p, model))
    state, acc = jax.lax.fori_loop(np.int32(0), np.int32(n), body, start, unroll=unroll)
    return finish(acc, state.x, state.v, n, tail, p, h), acc.T


def run_by_intervals(
    p: Params, model: Model, dt: jax.Array, n_steps: int, finer: int = 1, coarse: float = 1.0
) -> Run:
    """A run with located switches, for many scenarios side by side; not differentiable.

    An iteration is an interval, not a plant step: one that ends at a switch holds up only its own
    scenario. Each scenario takes at least as many intervals as plant steps; only the second loop
    has scenarios that have finished, and must keep their numbers.
    """
    h, n, tail = dt / finer, finer * n_steps, finer * (n_steps // 2)
    rest = coarse * rounding(p) * (h / p.period)

    def body(carry: Any) -> Any:
        state, progress, acc = carry
        begins = (state.k == tail) & (progress.pieces == 0)
        acc = where_rare(begins, lambda: begin_tail(acc), acc)
        after, progress, interval = step_to_switch(p, state, progress, model, h)
        return after, progress, update(acc, interval, state.k, rest, p, model)

    def unfinished(carry: Any) -> Any:
        return carry[0].k < np.int32(n)

    start = with_slopes(p, initial(p, model)), Progress.none(p.x_init), empty(p, model)
    carry = jax.lax.fori_loop(np.int32(0), np.int32(n), lambda _, carry: body(carry), start)
    state, _, acc = jax.lax.while_loop(unfinished, body, carry)
    return finish(acc, state.x, state.v, n, tail, p, h), acc.T
