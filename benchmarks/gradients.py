"""How far the gradients of the metrics are of use, metric by metric.

    python -m benchmarks.gradients [--scenarios N] [--by FIELD] [--set contact=welded ...]

The random scenarios of `benchmarks.trust` (10 s at 10 ms), differentiated by one field (K0) in
float64 with both integrators. All numbers are relative: the change of a metric, over its scale (of
its value, of T_n or of the run's time), for a relative change of the field. "own" is the share
whose derivative agrees to 1 % with the central difference over 1e-7 of the same program; "0.1 %"
the share that is more than 10 % off the central difference over 0.1 % of the motion (located
switches, steps of 1.25 ms), and "sign" the share that has its wrong sign. Derivatives and
differences below 1e-4 count as agreeing. The last column counts derivatives that are not finite in
float32.
"""

import argparse
import dataclasses
import sys
from typing import Any

import jax
import numpy as np

from benchmarks.trust import DT, FINER, N_STEPS, choices, scenarios
from fic_jax import QUANTITIES, TRUST, Metrics, Model, Params, evaluate, sweep

TINY, FINITE = 1e-7, 1e-3  # relative changes of the field
SMALL = 1e-4  # a relative derivative that changes nothing
TOGETHER = 25  # scenarios that one call of XLA differentiates
NAMES = [name for name in TRUST if name != "mode_switches"]  # a count has no derivative
COLUMNS = "| integrator, metric | own | off 0.1 % | sign | median | 99 % | largest | float32 |"


def changed(p: Params, by: str, part: float) -> Params:
    """The scenarios with one field changed by a part of its value."""
    return dataclasses.replace(p, **{by: getattr(p, by) * (1.0 + part)})


def derivatives(p: Params, by: str, **options: Any) -> Metrics:
    """The derivative of each metric for a relative change of a field, one for each scenario."""

    def one(p: Params) -> Any:
        def run(part: Any) -> Metrics:
            return evaluate(changed(p, by, part), **options)

        start = np.zeros((), p.K0.dtype)
        return jax.jvp(run, (start,), (np.ones_like(start),))[1]

    n = len(p.K0)
    filled = jax.tree.map(lambda leaf: np.broadcast_to(leaf, n), p)
    return jax.tree.map(
        np.asarray, jax.jit(lambda p: jax.lax.map(one, p, batch_size=TOGETHER))(filled)
    )


def difference(p: Params, by: str, part: float, **run: Any) -> Metrics:
    """The central difference of each metric for a relative change of a field."""
    low, high = (sweep(changed(p, by, sign * part), **run) for sign in (-1.0, 1.0))
    with np.errstate(invalid="ignore"):
        return jax.tree.map(lambda a, b: (b - 1.0 * a) / (2.0 * part), low, high)


def rows(n: int, n_steps: int, by: str, model: Model) -> list[str]:
    """The rows of one integrator."""
    p = scenarios(n)
    run: Any = {"model": model, "dt": DT, "n_steps": n_steps}
    metrics, exact = sweep(p, **run), derivatives(p, by, **run)
    single = derivatives(jax.tree.map(np.float32, p), by, **run)
    own = difference(p, by, TINY, **run)
    fine: Any = {"model": model.with_events(), "dt": DT / FINER, "n_steps": FINER * n_steps}
    motion = difference(p, by, FINITE, **fine)

    def row(name: str) -> str:
        value = getattr(metrics, name)
        scale = {"value": np.abs(value), "T_n": 1.0, "t_end": n_steps * DT}[TRUST[name].scale]
        with np.errstate(invalid="ignore", divide="ignore"):
            d, tiny, finite = (getattr(m, name) / scale for m in (exact, own, motion))
            counts = np.isfinite(value) & np.isfinite(tiny) & np.isfinite(finite) & (scale != 0)
            d, tiny, finite = d[counts], tiny[counts], finite[counts]
            agrees = np.abs(d - tiny) <= np.maximum(0.01 * np.abs(tiny), SMALL)
            off = ~(np.abs(d - finite) <= np.maximum(0.1 * np.abs(finite), SMALL))
            wrong = (d * finite < 0) & (np.maximum(np.abs(d), np.abs(finite)) > SMALL)
        if not counts.any():
            return f"| {model.integrator}, {name} |" + 7 * " |"
        shares = [f"{100 * part.mean():.1f} %" for part in (agrees, off, wrong)]
        sizes = [f"{q:.1g}" for q in np.quantile(np.abs(d), [0.5, 0.99, 1.0], method="lower")]
        lost = np.sum(~np.isfinite(getattr(single, name)[counts]))
        return f"| {' | '.join((f'{model.integrator}, {name}', *shares, *sizes, str(lost)))} |"

    return [row(name) for name in NAMES]


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--scenarios", type=int, default=400)
    parser.add_argument("--steps", type=int, default=N_STEPS)
    parser.add_argument("--by", choices=tuple(QUANTITIES), default="K0", metavar="FIELD")
    parser.add_argument("--set", action="append", default=[], metavar="CHOICE=OPTION")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    chosen = choices(parser, arguments.set)
    lines = [COLUMNS, "|---|" + 7 * "---:|"]
    for integrator in ("rk4", "rk4_events"):
        model = Model(**{"integrator": integrator} | chosen)  # type: ignore[arg-type]
        lines += rows(arguments.scenarios, arguments.steps, arguments.by, model)
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
