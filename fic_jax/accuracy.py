"""Error estimates: the difference between metrics and their limit for dt -> 0."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from fic_jax.metrics import Metrics, compiled_evaluate
from fic_jax.params import Model, Params, Scalar
from fic_jax.simulation import checked

TRUST = 0.01  # a scenario is trusted up to this relative error of nmse
# Halving the step removes three quarters of the error of a method of order 2. The error of rk4 is
# of first order and erratic; its companion is far more accurate, so the difference is the error.
_TO_LIMIT = {"rk4": 1.0, "rk4_events": 4.0 / 3.0}


def evaluate_with_error(
    params: Params, *, model: Model = Model(), dt: Scalar, n_steps: int
) -> tuple[Metrics, Metrics]:
    """`evaluate`, and the estimated absolute error of each metric in the metric's unit.

    A companion run has plant steps of dt/2, located switches (`rk4_events`) and the same sample
    times. The error estimate is the difference between the two runs (`rk4`), or 4/3 of it
    (`rk4_events`, a method of order 2). It is 0 if a metric is infinite in both runs. If a run
    becomes infinite or NaN, all errors are NaN and `finite` is false.

    Takes Params with scalar leaves; returns two Metrics with scalar leaves.

    Raises ParamsError if a value is out of bounds. Values under the caller's jit or vmap are not
    checked.
    """
    p, dt = checked(params, dt, n_steps)
    return estimated(p, model, dt, n_steps)


def estimated(
    p: Params, model: Model, dt: Scalar, n_steps: int, unroll: int = 1
) -> tuple[Metrics, Metrics]:
    """`evaluate_with_error` on canonical numbers; `unroll` as in `compiled_evaluate`."""
    metrics = compiled_evaluate(p, model, dt, n_steps, unroll=unroll)
    companion = compiled_evaluate(p, model.with_events(), dt, n_steps, substeps=2)
    return metrics, difference(metrics, companion, model)


def difference(metrics: Metrics, companion: Metrics, model: Model) -> Metrics:
    """The error of each metric, from its companion run."""
    finite, dtype = metrics.finite & companion.finite, metrics.nmse.dtype

    def error(a: jax.Array, b: jax.Array) -> jax.Array:
        a, b = a.astype(dtype), b.astype(dtype)
        apart = jnp.where(a == b, 0.0, _TO_LIMIT[model.integrator] * jnp.abs(a - b))
        return jnp.where(finite, apart, jnp.nan)

    return replace(jax.tree.map(error, metrics, companion), finite=finite)


def trusted(metrics: Metrics, errors: Metrics) -> Scalar:
    """Whether the error of nmse is at most TRUST (1 %) of nmse: bool, scalar or [N].

    Takes the two Metrics of `evaluate_with_error` or `sweep`. False if a run was not finite.
    """
    return errors.nmse <= TRUST * metrics.nmse
