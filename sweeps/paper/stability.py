"""C14: controllers superimposed on one inertia."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fic_jax import Model
from sweeps.paper.record import Claim, Condition, Evidence, Findings, Reading
from sweeps.paper.superposition import bodies, gains, simulate

SEED = 2020
GROWTH = 0.01  # of the energy at the start: what deciding once a millisecond may add
AT_REST = 0.01  # of the energy at the start, still kinetic at the end


def autonomous(reading: Reading) -> Model:
    """What of a reading matters where no reference searches and the stop is a hard one."""
    return Model(
        law=reading.model.law, divergence=reading.model.divergence, peak=reading.model.peak
    )


def c14(reading: Reading) -> Findings:
    """Random pairs and triples of controllers, free and against a stop."""
    kind, growth, left, ratio = _superimposed(autonomous(reading))
    evidence = (
        Evidence("energy gained, over the start's", growth, growth <= GROWTH, f"<= {GROWTH:g}"),
        Evidence("kinetic energy left after 20 s", left, left <= AT_REST, f"<= {AT_REST:g}"),
    )
    soft = ratio <= 1.5
    one = np.char.startswith(kind, "one reference")
    conditions = [
        Condition("", np.ones(len(growth), bool)),
        Condition("all rest on one reference", one),
        Condition("each has Fmax <= 3 K0 xb", ratio <= 3.0),
        Condition("each has Fmax <= 2 K0 xb", ratio <= 2.0),
        Condition("each has Fmax <= 1.5 K0 xb", soft),
        Condition("each has Fmax <= 1.5 K0 xb and all rest on one reference", soft & one),
    ]
    bad = _failing(kind, growth, left, ratio)
    numbers = {
        "bad": int(bad.sum()),
        "all": len(bad),
        "gained": float(growth.max()),
        "moving": float(left.max()),
        "ratio": float(ratio[bad].min()) if bad.any() else float("inf"),
        "one": int((bad & one).sum()),
        "older": int(_failing(*_superimposed(replace(autonomous(reading), law="energy"))).sum()),
    }
    key = f"{numbers['bad']} of {numbers['all']} draws gain energy or do not settle"
    names = [
        f"{i}: {what}, Fmax/(K0 xb) up to {r:.2g}"
        for i, (what, r) in enumerate(zip(kind, ratio, strict=True))
    ]
    return Findings(names, evidence, conditions, key, numbers)


def _failing(_: np.ndarray, growth: np.ndarray, left: np.ndarray, __: np.ndarray) -> np.ndarray:
    return (growth > GROWTH) | (left > AT_REST)


@lru_cache(maxsize=32)
def _superimposed(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Kind, energy gained, kinetic energy left and largest Fmax/(K0 xb) of 256 random draws."""
    n, random = 256, np.random.default_rng(SEED)
    shape, i = (n, 1, 3), np.arange(n)
    three, apart, stop = i % 2 == 1, i // 2 % 2 == 1, i // 4 % 2 == 1
    silent = ~three[:, None, None] & (np.arange(3) == 2)
    x0, K0 = random.uniform(0.03, 0.15, shape), log_uniform(random, 5.0, 300.0, shape)
    xb = x0 + random.uniform(0.005, 0.05, shape)
    # from a spring that only softens to one that stiffens twenty times between x0 and xb
    stiffest = log_uniform(random, 1.0, 20.0, n)[:, None, None]
    Fmax = np.maximum(K0 * xb * (0.9 + random.random(shape) * (stiffest - 0.9)), K0 * x0)
    xd = np.where(apart[:, None, None], random.uniform(-0.1, 0.1, shape), 0.0)
    controllers = gains(
        K0=np.where(silent, 1e-6, K0), Fmax=np.where(silent, 1e-6, Fmax), x0=x0, xb=xb, xd=xd
    )
    body = bodies(
        n,
        I=log_uniform(random, 1.0, 20.0, n),
        x_init=random.uniform(-0.3, 0.3, n),
        Kenv=np.where(stop, log_uniform(random, 20.0, 500.0, n), 0.0),
        Denv=np.where(stop, random.uniform(0.0, 200.0, n), 0.0),
        gap=random.uniform(-0.1, 0.3, n),
    )
    seen = simulate(controllers, body, model, 20.0)
    ratio = np.where(silent, 0.0, Fmax / (K0 * xb)).max(axis=(1, 2))
    kind = [
        f"{'references apart' if a else 'one reference'}, {3 if t else 2} controllers, "
        f"{'stop' if s else 'free'}"
        for a, t, s in zip(apart, three, stop, strict=True)
    ]
    growth = seen.energy.max(axis=1) / seen.start - 1.0
    return np.array(kind), growth, seen.kinetic[:, -10:].max(axis=1) / seen.start, ratio


def log_uniform(
    random: np.random.Generator, low: float, high: float, shape: int | tuple[int, ...]
) -> np.ndarray:
    """Random numbers, even on a log scale."""
    return np.asarray(np.exp(random.uniform(np.log(low), np.log(high), shape)))


CLAIMS = (
    Claim(
        "C14",
        "Superimposed controllers stay stable",
        "Multiple controllers can be superimposed without interfering with the system stability.",
        "Sec. I; Sec. V",
        "256 random draws of two or three controllers, searching nothing, on one inertia released "
        "at rest, with one "
        "reference or references up to 0.1 rad apart, free or against a hard stop; "
        "Fmax/(K0 xb) from 0.9 to 20. 20 s at 1 ms.",
        "fic-sweep report --only C14",
        "energy",
        c14,
        {
            "holds": "No draw gains energy and all come to rest.",
            "holds where": "{bad} of {all} draws gain energy (up to {gained:.2g} times the "
            "start's) or keep moving (up to {moving:.2g} of it kinetic after 20 s), {one} of them "
            "with one reference; the mildest has Fmax = {ratio:.2g} K0 xb. There a spring stiffens "
            "between x0 and xb, and the slope 2 F_K(e_M)/e_M releases more than divergence has "
            "stored (the area between x0 and xb of fig:1a), for another controller to take up. "
            "With the older law (4 E_K/e_M² throughout) {older} of the draws fail.",
            "does not hold": "{bad} of {all} draws gain energy (up to {gained:.2g} times the "
            "start's) or keep moving (up to {moving:.2g} of it kinetic after 20 s).",
        },
    ),
)
