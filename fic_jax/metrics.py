"""Metrics, summed sample by sample: no trajectory is stored.

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

from fic_jax.environment import in_contact
from fic_jax.lanes.hints import where_rare
from fic_jax.params import Model, Params, Scalar, check_count
from fic_jax.simulation import Sample, checked, init, sampled, with_slopes

SETTLING_BAND = 0.05  # the torque has converged while |T/T_n - 1| is at most this


def _metric(unit: str, meaning: str) -> Any:
    return field(metadata={"unit": unit, "meaning": meaning})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Metrics:
    """The metrics of one scenario (scalars) or of N ([N] leaves); METRICS has their units."""

    nmse: Scalar = _metric("1", "normalised mean square torque error, whole run")
    nmse_tail: Scalar = _metric("1", "normalised mean square torque error, second half")
    convergence_time: Scalar = _metric("s", "time from which the torque stays within 5 %")
    steady_error: Scalar = _metric("1", "mean normalised torque error, second half")
    peak_torque: Scalar = _metric("N*m", "largest interaction torque")
    overshoot: Scalar = _metric("1", "largest torque over the reachable one, less 1")
    contact_time: Scalar = _metric("s", "time of first contact")
    contact_lost: Scalar = _metric("s", "time out of contact after the first touch")
    mode_switches: Scalar = _metric("1", "switches between divergence and convergence")
    energy_in: Scalar = _metric("J", "work done by the controller")
    finite: Scalar = _metric("1", "1 if the run stayed within the finite numbers")


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
    """Running sums and extremes of one scenario. Times are counts of samples: exact in int32."""

    square_head: Scalar  # sum of eps^2 over the first half, 0 before the second begins
    square: Sum  # of eps^2, over the current half
    error: Sum  # of eps, over the current half
    outside: Scalar  # samples up to and including the last one outside the settling band
    highest: Scalar  # N*m, largest T, at least 0
    lowest: Scalar  # N*m, smallest T, at most 0; always 0 at a hard stop, which does not pull
    before_touch: Scalar  # samples before the first one in contact
    touched: Scalar  # samples in contact
    switches: Scalar  # of the branch, so far
    diverging: Scalar  # branch of the last sample
    work: Sum  # J


def reachable(p: Params) -> jax.Array:
    """The reachable torque T_n = sgn(Td) min(|Td|, Fmax), N*m; eps is in units of it."""
    return jnp.sign(p.Td) * jnp.minimum(jnp.abs(p.Td), p.Fmax)


def empty(p: Params) -> Accumulator:
    """The accumulator before the first sample."""
    zero, none = jnp.zeros_like(p.Td), jnp.zeros_like(p.Td, jnp.int32)
    yes = jnp.ones_like(p.Td, bool)
    sum_ = Sum(zero, zero)
    return Accumulator(zero, sum_, sum_, none, zero, zero, none, none, none, yes, sum_)


def _count(total: Scalar, event: Scalar) -> jax.Array:
    return total + event.astype(jnp.int32)


def begin_tail(acc: Accumulator) -> Accumulator:
    """The accumulator where the second half begins: its sums start from zero."""
    none = Sum(jnp.zeros_like(acc.square.total), jnp.zeros_like(acc.square.excess))
    return dataclasses.replace(acc, square_head=acc.square.total, square=none, error=none)


def update(
    acc: Accumulator, sample: Sample, k: Scalar, n_steps: int, p: Params, model: Model
) -> Accumulator:
    """Add sample k (counted from 0) of `n_steps`."""
    acc = where_rare(k == n_steps // 2, lambda: begin_tail(acc), acc)
    per_T_n = 1.0 / reachable(p)
    eps = (sample.tau_env - p.Td) * per_T_n
    settled = jnp.abs(sample.tau_env * per_T_n - 1.0) <= SETTLING_BAND  # false for NaN
    touching = in_contact(sample.x, p, model)
    touched = _count(acc.touched, touching)
    pulls = model.contact != "hard_stop"
    return Accumulator(
        square_head=acc.square_head,
        square=acc.square.plus(eps**2),
        error=acc.error.plus(eps),
        outside=jnp.where(settled, acc.outside, k + 1),
        highest=jnp.maximum(acc.highest, sample.tau_env),
        lowest=jnp.minimum(acc.lowest, sample.tau_env) if pulls else acc.lowest,
        before_touch=jnp.where(touched > 0, acc.before_touch, k + 1),
        touched=touched,
        switches=_count(acc.switches, (sample.diverging != acc.diverging) & (k > 0)),
        diverging=sample.diverging,
        work=acc.work.plus(sample.work),
    )


def finish(
    acc: Accumulator, x: Scalar, v: Scalar, n_steps: int, p: Params, dt: jax.Array
) -> Metrics:
    """Metrics from the sums. Sample k is at time (k + 1) dt; inf stands for "does not happen".

    `x` and `v` are the last sample's: once they are infinite or NaN they remain so.
    """

    def seconds(samples: Scalar) -> jax.Array:
        return samples.astype(dt.dtype) * dt

    n_tail = n_steps - n_steps // 2
    nmse = (acc.square_head + acc.square.total) / n_steps
    T_n = reachable(p)
    lost = n_steps - acc.before_touch - acc.touched
    return Metrics(
        nmse=nmse,
        nmse_tail=acc.square.total / n_tail,
        convergence_time=jnp.where(acc.outside < n_steps, seconds(acc.outside + 1), jnp.inf),
        steady_error=acc.error.total / n_tail,
        peak_torque=jnp.abs(jnp.maximum(acc.highest, -acc.lowest)),  # abs: the larger may be -0
        overshoot=jnp.maximum(jnp.where(T_n < 0.0, acc.lowest, acc.highest) / T_n - 1.0, 0.0),
        contact_time=jnp.where(acc.touched > 0, seconds(acc.before_touch + 1), jnp.inf),
        contact_lost=seconds(lost),
        mode_switches=acc.switches,
        energy_in=acc.work.total,
        finite=jnp.isfinite(x)
        & jnp.isfinite(v)
        & jnp.isfinite(nmse)
        & jnp.isfinite(acc.work.total),
    )


def blank(p: Params, dt: Scalar) -> Metrics:
    """Metrics without a run, for their types."""
    return finish(empty(p), p.x_init, p.v_init, 2, p, dt)


def evaluate(
    params: Params, *, model: Model = Model(), dt: Scalar, n_steps: int, substeps: int = 1
) -> Metrics:
    """Metrics of one scenario over `n_steps` samples, one every `dt` seconds; none is stored.

    Takes Params with scalar leaves; returns Metrics with scalar leaves. A sample is the end of a
    plant step of `dt` seconds, or of `substeps` plant steps of dt/substeps: then the integration is
    finer and the samples are at the same times. vmap, grad and the caller's jit apply.

    Raises ParamsError if a value is out of bounds. Values under the caller's jit or vmap are not
    checked.
    """
    check_count("substeps", substeps)
    p, dt = checked(params, dt, n_steps)
    return compiled_evaluate(p, model, dt, n_steps, substeps)


@partial(jax.jit, static_argnames=("model", "n_steps", "substeps", "unroll"))
def compiled_evaluate(
    p: Params, model: Model, dt: jax.Array, n_steps: int, substeps: int = 1, unroll: int = 1
) -> Metrics:
    """`evaluate` on canonical numbers; a compiled iteration takes `unroll` samples."""

    def body(k: jax.Array, carry: Any) -> Any:
        state, acc = carry
        state, sample = sampled(p, state, model, dt / substeps, substeps)
        return state, update(acc, sample, k, n_steps, p, model)

    start = (with_slopes(p, init(p, model)), empty(p))
    state, acc = jax.lax.fori_loop(np.int32(0), np.int32(n_steps), body, start, unroll=unroll)
    return finish(acc, state.x, state.v, n_steps, p, dt)
