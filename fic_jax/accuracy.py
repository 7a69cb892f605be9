"""How far a scenario's metrics are from what an ever shorter plant step would give."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from fic_jax.metrics import Metrics, compiled_evaluate
from fic_jax.params import Model, Params, Scalar
from fic_jax.simulation import checked

TRUST = 0.01  # relative error of nmse up to which a scenario is trusted
# A method of order 2 gains three quarters of its error when the step is halved. rk4 is of first
# order and errs erratically; its companion is better by far and the difference is the error.
_TO_LIMIT = {"rk4": 1.0, "rk4_events": 4.0 / 3.0}


def evaluate_with_error(
    params: Params, *, model: Model = Model(), dt: Scalar, n_steps: int
) -> tuple[Metrics, Metrics]:
    """`evaluate`, and the estimated absolute error of each metric.

    The scenario also runs with plant steps of dt/2 and its switches located (`rk4_events`), with
    the same samples; the difference tells the error. A metric that is infinite in both runs has
    none; where one of the runs left the finite numbers all are NaN, and `finite` is false.

    Raises ParamsError if a concrete value is out of bounds.
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
    """The error of each metric by the run that accompanied it."""
    finite, dtype = metrics.finite & companion.finite, metrics.nmse.dtype

    def error(a: jax.Array, b: jax.Array) -> jax.Array:
        a, b = a.astype(dtype), b.astype(dtype)
        apart = jnp.where(a == b, 0.0, _TO_LIMIT[model.integrator] * jnp.abs(a - b))
        return jnp.where(finite, apart, jnp.nan)

    return replace(jax.tree.map(error, metrics, companion), finite=finite)


def trusted(metrics: Metrics, errors: Metrics) -> Scalar:
    """Whether nmse is known to 1 % of itself; never where a run left the finite numbers."""
    return errors.nmse <= TRUST * metrics.nmse
