"""Error estimates: the difference between metrics and their limit for dt -> 0."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax.events import FLAT
from fic_jax.inputs import ParamsError, Scalar, expect, on_host, real, shown, transferred
from fic_jax.metrics import Metrics, Run, deviation, reachable, run_by_steps
from fic_jax.params import Model, Params
from fic_jax.piece import rounding
from fic_jax.simulation import checked


@dataclass(frozen=True)
class Bound:
    """The largest estimated error of a trusted metric: a part of a scale, and at least a floor."""

    part: float
    scale: str  # of what `part` is: "value", of the metric itself; "T_n"; "t_end"
    floor: float = 0.0  # in the metric's unit

    def error(self, value: Scalar, t_end: Scalar) -> Scalar:
        """The bound in the metric's unit. Errors in units of T_n have the scale 1."""
        scale = {"value": jnp.abs(value), "T_n": 1.0, "t_end": t_end}[self.scale]
        return jnp.maximum(self.part * scale, self.floor)


TRUST = {
    "nmse": Bound(0.01, "value", floor=1e-12),
    "nmse_tail": Bound(0.01, "value", floor=1e-12),
    "convergence_time": Bound(0.01, "t_end"),
    "steady_error": Bound(0.01, "T_n"),
    "peak_torque": Bound(0.01, "value"),
    "overshoot": Bound(0.01, "T_n"),
    "contact_time": Bound(0.01, "t_end"),
    "contact_lost": Bound(0.01, "t_end"),
    "mode_switches": Bound(0.01, "value"),
    "energy_in": Bound(0.01, "value", floor=1e-6),
}

# The error estimate is a multiple of the difference from the companion run. The companion of an rk4
# run is far more accurate, so the difference is the error; a half more, and two runs with other
# steps agree within the sum of their estimates (99 % of 4,096 scenarios; 93 % without).
_OF_DIFFERENCE = {"rk4": 1.5, "rk4_events": 2.0}
# The companion's relative change of parameters, in units of CHANGE[bits]: no two cancel.
CHANGES = {"K0": 1.0, "Kenv": -0.7, "I": 0.6, "Td": -0.8, "sigma": 0.9, "Denv": 0.5}
CHANGE = {32: 4e-6, 64: 1e-10}  # what some hundred steps make of the rounding of parameters
# The companion's joint counts as at rest earlier: switches that depend on it are not trusted.
COARSE = 1e4
# Two located runs that end with torques further apart than this part of T_n have become different
# motions, as in chaos: that their sums agree is luck.
APART = 0.003
SUMS = ("nmse", "nmse_tail", "steady_error", "contact_lost", "mode_switches", "energy_in")


def evaluate_with_error(
    params: Params, *, model: Model = Model(), dt: Scalar, n_steps: int
) -> tuple[Metrics, Metrics]:
    """`evaluate`, and the estimated absolute error of each metric in the metric's unit.

    A companion run has plant steps of dt/2, located switches (`rk4_events`), and parameters changed
    by 1e-10 (float64) or 4e-6 (float32): a scenario that hangs on a coin gets a large error. The
    error estimate is 1.5 times the difference between the two runs (`rk4`), or twice that
    (`rk4_events`). It is 0 if a time is infinite in both runs; infinite if the runs part, that is
    if they end with torques that differ by more than 0.3 % of T_n (`rk4_events`: all sums). If a
    run becomes infinite or NaN, all errors are NaN and `finite` is false.

    Takes Params with scalar leaves; returns two Metrics with scalar leaves.

    Raises ParamsError if a value is out of bounds. Values under the caller's jit or vmap are not
    checked.
    """
    p, dt, n_steps = checked(params, dt, n_steps, model)
    return transferred(compiled_estimated, p, dt, model=model, n_steps=n_steps)


@partial(jax.jit, static_argnames=("model", "n_steps"))
def compiled_estimated(
    p: Params, dt: Scalar, model: Model, n_steps: int
) -> tuple[Metrics, Metrics]:
    """`evaluate_with_error` on canonical numbers."""
    return estimated(p, model, dt, n_steps, run_by_steps)


def estimated(
    p: Params, model: Model, dt: Scalar, n_steps: int, run: Callable[..., Run]
) -> tuple[Metrics, Metrics]:
    """The metrics and errors of a scenario; `run` simulates it."""
    metrics, T = run(p, model, dt, n_steps)
    change = CHANGE[jnp.finfo(p.K0.dtype).bits]
    nearby = replace(
        p, **{name: getattr(p, name) * (1.0 + part * change) for name, part in CHANGES.items()}
    )
    companion, T_companion = run(nearby, model.with_events(), dt, n_steps, finer=2, coarse=COARSE)
    apart = jnp.abs(deviation(T, p) - deviation(T_companion, nearby)) > APART
    errors = difference(metrics, companion, apart, model)
    return metrics, with_rounding(errors, metrics, p)


def difference(metrics: Metrics, companion: Metrics, apart: Scalar, model: Model) -> Metrics:
    """The error of each metric, from its companion run; `apart`: it ends with another torque."""
    finite, dtype = metrics.finite & companion.finite, metrics.nmse.dtype

    def error(a: jax.Array, b: jax.Array) -> jax.Array:
        a, b = a.astype(dtype), b.astype(dtype)
        error = jnp.where(a == b, 0.0, _OF_DIFFERENCE[model.integrator] * jnp.abs(a - b))
        return jnp.where(finite, error, jnp.nan)

    errors = jax.tree.map(error, metrics, companion)
    if model.integrator == "rk4":  # it does not see what switches within a step
        errors = replace(errors, mode_switches=errors.mode_switches + 1.0)
    else:
        lucky = {name: jnp.where(apart & finite, jnp.inf, getattr(errors, name)) for name in SUMS}
        errors = replace(errors, **lucky)
    return replace(errors, finite=finite)


def with_rounding(errors: Metrics, metrics: Metrics, p: Params) -> Metrics:
    """The errors, and what no second run sees.

    Algorithm 2 stalls where its step sigma/K0 (Td - F) is below the rounding of x_h. And a flat
    extreme between two samples is left out (`FLAT`).
    """
    T_n = jnp.abs(reachable(p))
    searches = p.sigma > 0.0
    stall = rounding(p) / 8.0 * p.K0 / jnp.where(searches, p.sigma, 1.0) / T_n
    stall = jnp.where(searches, stall, 0.0)
    return replace(
        errors,
        nmse=errors.nmse + stall**2,
        nmse_tail=errors.nmse_tail + stall**2,
        steady_error=errors.steady_error + stall,
        peak_torque=errors.peak_torque + FLAT * metrics.peak_torque,
        overshoot=errors.overshoot + FLAT * (1.0 + metrics.overshoot),
    )


def trusted(metrics: Metrics, errors: Metrics, t_end: Scalar) -> Metrics:
    """Whether the estimated error of each metric is within its bound, `TRUST`: bool leaves.

    Takes the two Metrics of `evaluate_with_error` or `sweep` (scalars or [N]), and the duration of
    the run in seconds. False where a run was not finite. An infinite time is trusted if it is
    infinite in both runs. The leaf `finite` says whether both runs were.

    Raises ParamsError if an argument is of another type, or the two Metrics differ in length.
    """
    for name, given in {"metrics": metrics, "errors": errors}.items():
        expect(name, given, Metrics, "those of sweep(..., error_estimate=True)")
    duration = real("t_end", t_end)
    if not isinstance(duration, jax.core.Tracer):
        number = on_host(duration)
        if np.ndim(number) or not 0 < number < np.inf:
            raise ParamsError("t_end", shown(t_end), "a number, positive and finite, in s")
    for name in TRUST:
        shape, other = (np.shape(real(name, getattr(m, name))) for m in (metrics, errors))
        if shape != other:
            raise ParamsError("errors", f"of shape {other}", f"of the metrics' shape, {shape}")
    with jax.transfer_guard_host_to_device("allow"):  # of the user's own numbers
        return _judged(metrics, errors, duration)


def _judged(metrics: Metrics, errors: Metrics, t_end: Scalar) -> Metrics:

    def within(name: str) -> Scalar:
        error = jnp.asarray(getattr(errors, name))
        value = jnp.asarray(getattr(metrics, name)).astype(error.dtype)
        bound = TRUST[name].error(jnp.where(jnp.isfinite(value), value, 0.0), t_end)
        return errors.finite & (error <= bound)

    return Metrics(**{name: within(name) for name in TRUST}, finite=errors.finite)
