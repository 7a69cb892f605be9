"""How right the metrics, their error estimates and their trust are, metric by metric.

    python -m benchmarks.trust [--scenarios N] [--precision 32|64] [--set contact=welded ...]

Seeded random scenarios (10 s at 10 ms) are compared with their motion: located switches in float64
with eight steps of 1.25 ms for each one. A scenario is regular for a metric if a change of K0, I,
Kenv and Td by 1e-6 moves it by at most 2e-5 (relative, of T_n, or of the run's time). "agree" is
the share whose runs at 10 ms and 2.5 ms differ by at most the sum of their error estimates;
"bracketed" the share whose error is at most five times its estimate; "false" the share of the
trusted ones that are off by more than their bound.
"""

import argparse
import dataclasses
import sys
from typing import Any

import jax
import numpy as np

from fic_jax import CHOICES, TRUST, Metrics, Model, Params, sweep, trusted

SEED = 7
DT, N_STEPS, T_END = 0.01, 1000, 10.0
FINER = 8
CHANGE, MOST = 1e-6, 2e-5
COLUMNS = "| metric | regular | median error | 90 % | 99 % | trusted | false | agree | bracketed |"
# errors below are rounding
FLOOR = {"value": 1e-9, "T_n": 1e-9, "t_end": 1e-9}


def scenarios(n: int) -> Params:
    """Random scenarios over the range of the library's atlases, half of them with an approach."""
    rng = np.random.default_rng(SEED)

    def log(low: float, high: float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), n))

    gap = np.where(rng.random(n) < 0.5, 0.0, rng.uniform(0.0, 0.5, n))
    return Params(
        K0=log(1.0, 1000.0),
        Kenv=log(10.0, 1000.0),
        Denv=np.where(rng.random(n) < 0.2, 0.0, rng.uniform(0.0, 300.0, n)),
        Td=rng.uniform(1.0, 20.0, n),
        sigma=log(0.001, 0.1),
        I=log(3.0, 20.0),
        gap=gap,
        xd=np.where(rng.random(n) < 0.5, gap, 0.0),
        period=np.where(rng.random(n) < 0.5, 0.01, 0.02),
    )


def rows(n: int, model: Model, dtype: Any) -> list[str]:
    """The rows of the table."""
    p = jax.tree.map(lambda a: np.asarray(a, dtype), scenarios(n))
    exact = jax.tree.map(lambda a: np.asarray(a, np.float64), p)
    nearby = dataclasses.replace(
        exact,
        K0=exact.K0 * (1.0 + CHANGE),
        I=exact.I * (1.0 - CHANGE),
        Kenv=exact.Kenv * (1.0 + 0.7 * CHANGE),
        Td=exact.Td * (1.0 - 0.5 * CHANGE),
    )
    found, errors = sweep(p, model=model, dt=DT, n_steps=N_STEPS, error_estimate=True)
    fine, of_fine = sweep(p, model=model, dt=DT / 4, n_steps=4 * N_STEPS, error_estimate=True)
    options: Any = {"model": model.with_events(), "dt": DT / FINER, "n_steps": FINER * N_STEPS}
    truth, moved = sweep(exact, **options), sweep(nearby, **options)
    flags = trusted(found, errors, T_END)

    def row(name: str) -> str:
        def of(metrics: Metrics) -> np.ndarray:
            return np.asarray(getattr(metrics, name), np.float64)

        scale = {"value": np.abs(of(truth)), "T_n": 1.0, "t_end": T_END}[TRUST[name].scale]
        least_scale = 1.0 if name == "mode_switches" else 1e-12
        least = FLOOR[TRUST[name].scale] * np.maximum(scale, 1e-3)
        runs = np.asarray(found.finite & errors.finite & fine.finite & truth.finite)
        with np.errstate(invalid="ignore", divide="ignore"):
            error = _apart(of(found), of(truth))
            regular = runs & (_apart(of(truth), of(moved)) <= MOST * scale + 1e-12)
            relative = error[regular] / np.broadcast_to(np.maximum(scale, least_scale), n)[regular]
            quantiles = np.quantile(relative, [0.5, 0.9, 0.99], method="lower")
            bound = np.asarray(
                TRUST[name].error(np.where(np.isfinite(of(found)), of(found), 0.0), T_END)
            )
            flag = of(flags).astype(bool) & runs
            wrong = flag & ~(error <= bound)
            agree = _apart(of(found), of(fine)) <= of(errors) + of(of_fine) + least
            counts = runs & (error > least) & np.isfinite(error)
            bracketed = error[counts] <= 5.0 * of(errors)[counts]
        numbers = [f"{q:.0e}" for q in quantiles]
        false = wrong.sum() / max(flag.sum(), 1)
        inside = f"{100 * bracketed.mean():.1f} %" if counts.any() else ""
        shares = f"{100 * flag.mean():.1f} %", f"{100 * false:.2f} %"
        cells = (f"{100 * regular.mean():.0f} %", *numbers, *shares)
        return f"| {' | '.join((name, *cells, f'{100 * agree[runs].mean():.1f} %', inside))} |"

    return [row(name) for name in TRUST]


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The distance of two numbers, 0 if both are infinite."""
    return np.where(a == b, 0.0, np.abs(a - b))


def choices(parser: argparse.ArgumentParser, texts: list[str]) -> dict[str, str]:
    """Choices of Model from `--set CHOICE=OPTION`; ends the program for another name."""
    chosen = dict(text.split("=", 1) for text in texts)
    if unknown := chosen.keys() - CHOICES:
        parser.error(f"--set: {', '.join(sorted(unknown))} is no choice of Model")
    return chosen


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--scenarios", type=int, default=4096)
    parser.add_argument("--precision", type=int, choices=(32, 64), default=64)
    parser.add_argument("--set", action="append", default=[], metavar="CHOICE=OPTION")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    model = Model(**{"integrator": "rk4_events"} | choices(parser, arguments.set))  # type: ignore[arg-type]
    dtype = np.float32 if arguments.precision == 32 else np.float64
    lines = [COLUMNS, "|---|" + 8 * "---:|", *rows(arguments.scenarios, model, dtype)]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
