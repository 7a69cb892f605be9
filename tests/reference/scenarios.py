"""Seeded random scenarios that cover every combination of the static choices evenly."""

from itertools import product

import numpy as np

from .laws import Choices, Params

CHOICES = {
    "contact": ("hard_stop", "damped_rebound", "welded"),
    "law": ("algorithm1", "effort", "energy"),
    "divergence": ("velocity", "error_rate", "velocity_band"),
    "peak": ("latched", "running"),
    "feedback": ("interaction", "motor"),
    "expectation": ("displacement", "error"),
}
"""Every named variant of model.md; the 216 combinations are cycled through."""


def random_scenarios(n: int, seed: int) -> list[tuple[Params, Choices]]:
    """n scenarios: parameters drawn at random, choices from the shuffled cycle of combinations.

    The cycle is shuffled, so that a short list is a fair sample too; a list of 216 holds each
    combination once. Angles in rad, torques in N·m, times in s.
    """
    rng = np.random.default_rng(seed)
    combinations = [dict(zip(CHOICES, c, strict=True)) for c in product(*CHOICES.values())]
    order = rng.permutation(len(combinations))
    return [(random_params(rng), dict(combinations[order[i % len(order)]])) for i in range(n)]


def random_params(rng: np.random.Generator) -> Params:
    """One parameter set; one in ten may have K0 x0 > Fmax, where eq. 1 is not monotone."""

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    Fmax, x0 = float(rng.uniform(10.0, 30.0)), float(rng.uniform(0.05, 0.15))
    stiffest = 300.0 if rng.random() < 0.1 else min(300.0, 0.95 * Fmax / x0)
    gap = 0.0 if rng.random() < 0.4 else float(rng.uniform(0.0, 0.5))
    return {
        "K0": log(5.0, stiffest),
        "Fmax": Fmax,
        "x0": x0,
        "xb": x0 + float(rng.uniform(0.01, 0.05)),
        "S": float(rng.uniform(5.0, 20.0)),
        "Td": float(rng.uniform(1.0, 12.0)),
        "xd": float(rng.choice([0.0, gap, gap - 0.02, gap + 0.02])),
        "sigma": log(0.002, 0.05),
        "period": 0.02 * int(rng.integers(1, 11)),
        "I": log(1.0, 20.0),
        "Kenv": log(20.0, 1000.0),
        "Denv": 0.0 if rng.random() < 0.15 else float(rng.uniform(0.0, 300.0)),
        "gap": gap,
        "x_init": 0.0 if rng.random() < 0.2 else float(rng.uniform(-0.2, 0.2)),
        "v_init": 0.0 if rng.random() < 0.4 else float(rng.uniform(-1.0, 1.0)),
    }
