"""C14 and C15: controllers superimposed, and gains changed while running."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fic_jax import Model, Params
from sweeps.report.record import Claim, Condition, Evidence, Findings, Reading
from sweeps.report.superposition import DT, History, bodies, gains, simulate

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
    x0, K0 = random.uniform(0.03, 0.15, shape), _log(random, 5.0, 300.0, shape)
    xb = x0 + random.uniform(0.005, 0.05, shape)
    # from a spring that only softens to one that stiffens twenty times between x0 and xb
    stiffest = _log(random, 1.0, 20.0, n)[:, None, None]
    Fmax = np.maximum(K0 * xb * (0.9 + random.random(shape) * (stiffest - 0.9)), K0 * x0)
    xd = np.where(apart[:, None, None], random.uniform(-0.1, 0.1, shape), 0.0)
    controllers = gains(
        K0=np.where(silent, 1e-6, K0), Fmax=np.where(silent, 1e-6, Fmax), x0=x0, xb=xb, xd=xd
    )
    body = bodies(
        n,
        I=_log(random, 1.0, 20.0, n),
        x_init=random.uniform(-0.3, 0.3, n),
        Kenv=np.where(stop, _log(random, 20.0, 500.0, n), 0.0),
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


def _log(
    random: np.random.Generator, low: float, high: float, shape: int | tuple[int, ...]
) -> np.ndarray:
    return np.asarray(np.exp(random.uniform(np.log(low), np.log(high), shape)))


RATIOS = (1.5, 2.0, 2.9, 3.2, 4.0, 10.0)  # of the stiffnesses alternated between
SECONDS = 40.0
RELEASE = 0.02  # rad, where the joint is released
SLICES = 50  # of a history: its last quarter
BEATS = np.geomspace(0.3, 8.0, 12)  # s


def c15(reading: Reading) -> Findings:
    """K0 changed at random, at a steady beat, and in step with the motion."""
    names, ratio, seen = _retuned(autonomous(reading))
    # what the energy of the start allows with the softest gain
    swing = seen.swing.max(axis=1) / (RELEASE * np.sqrt(ratio))
    extra = (seen.energy / (seen.start[:, None] + seen.injected)).max(axis=1) - 1.0
    evidence = (
        Evidence("largest |x| over x(0) sqrt(r)", swing, swing <= 1.0 + GROWTH, "<= 1"),
        Evidence(
            "energy beyond the start's and what the changes add",
            extra,
            extra <= GROWTH,
            f"<= {GROWTH:g}",
        ),
    )
    kind = np.array([name.split(",")[0] for name in names])
    step = kind == "in step with the motion"
    conditions = [
        Condition("", np.ones(len(names), bool)),
        Condition("K0 changes by less than 3 times", ratio < 3.0),
        Condition("K0 does not change in step with the motion", ~step),
        Condition("K0 changes once", kind == "once"),
    ]
    bad = (swing > 1.0 + GROWTH) | (extra > GROWTH)
    last = seen.swing[:, -SLICES:].max(axis=1) / RELEASE
    numbers = {
        "swing": float(swing.max()),
        "small": float(last[step & (ratio == 2.9)][0]),
        "grown": float(last[step & (ratio == 3.2)][0]),
        "bad": int(bad.sum()),
        "all": len(names),
        "beats": int((bad & ~step).sum()),
        "extra": float(extra.max()),
    }
    key = f"the swing grows in {numbers['bad']} of {len(names)} runs"
    return Findings(names, evidence, conditions, key, numbers)


@lru_cache(maxsize=32)
def _retuned(model: Model) -> tuple[list[str], np.ndarray, History]:
    """Names, ratio of the largest to the smallest K0, and what is seen of the runs."""
    random, t = np.random.default_rng(SEED), np.arange(round(SECONDS / DT)) * DT
    names, schedules = [], []
    for ratio in RATIOS:
        low, high = 100.0 / ratio, 100.0
        for i in range(4):
            moment = random.uniform(0.2, 5.0)
            up = i % 2 == 0
            schedules.append(np.where((t < moment) == up, low, high))
            names.append(f"once, {'up' if up else 'down'} {ratio:g} times at {moment:.2g} s")
            mean = (0.1, 0.3, 1.0, 3.0)[i]
            schedules.append(_random_steps(random, t, low, high, mean))
            names.append(f"at random, within {ratio:g} times every {mean:g} s")
        for beat in BEATS:
            schedules.append(np.where(t % beat < beat / 2.0, high, low))
            names.append(f"at a beat, by {ratio:g} times every {beat:.2g} s")
        schedules.append(in_step(high, low, t))
        names.append(f"in step with the motion, by {ratio:g} times")
    K0 = np.array(schedules)[..., None]
    n = len(names)
    seen = simulate(gains(K0=K0), bodies(n, x_init=np.full(n, RELEASE)), model, SECONDS)
    return names, np.repeat(RATIOS, n // len(RATIOS)), seen


def _random_steps(
    random: np.random.Generator, t: np.ndarray, low: float, high: float, mean: float
) -> np.ndarray:
    """K0 at times t, drawn anew at random moments, `mean` seconds apart."""
    moments = np.cumsum(random.exponential(mean, round(3 * SECONDS / mean)))
    values = _log(random, low, high, len(moments) + 1)
    return values[np.searchsorted(moments, t)]


def in_step(high: float, low: float, t: np.ndarray) -> np.ndarray:
    """K0 at times t: `high` from the peak to half of it, `low` from there to the next peak.

    In the linear zone convergence is an oscillation of rate sqrt(2 K0/I) about e_M/2, divergence
    one of sqrt(K0/I) about 0: the times are those of any energy. Each round multiplies the peak
    by sqrt((high/low - 1)/2), and by more than 1 where high > 3 low.
    """
    I = Params().I  # noqa: E741  the paper's symbol
    first = 0.5 * np.pi / np.sqrt(2.0 * high / I)
    second = np.arcsin(np.sqrt(low / high)) / np.sqrt(2.0 * low / I)
    third = 0.5 * np.pi / np.sqrt(low / I)
    return np.where(t % (first + second + third) < first, high, low)


CLAIMS = (
    Claim(
        "C14",
        "Superimposed controllers stay stable",
        "Multiple controllers can be superimposed without interfering with the system stability.",
        "Sec. I; Sec. V",
        "256 random draws of two or three controllers on one inertia, released at rest, with one "
        "reference or references up to 0.1 rad apart, free or against a hard stop; "
        "Fmax/(K0 xb) from 0.9 to 20. 20 s at 1 ms.",
        "fic-sweep report --only C14",
        "",
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
    Claim(
        "C15",
        "Gains may change online",
        "The controller passivity also enables to modify the controller parameters online without "
        "concerns for its stability.",
        "Sec. V; Sec. I",
        "One controller, free, released at rest at 0.02 rad; K0 between 100/r and 100 for r = 1.5 "
        "to 10, changed once, at random moments, at a steady beat, or in step with the motion: "
        "stiff from the peak to half of it, soft from there on. 40 s at 1 ms.",
        "fic-sweep report --only C15",
        "",
        c15,
        {
            "holds": "The swing never grows.",
            "holds where": "In the linear zone a change in step with the motion multiplies the "
            "peak by sqrt((r - 1)/2) each round, which is more than 1 for r > 3: with r = 2.9 the "
            "swing has fallen to {small:.2g} of x(0) after 40 s, with r = 3.2 it has grown "
            "{grown:.2g} times; {beats} of the other runs grow. The energy exceeds the start's and "
            "what the changes add by {extra:.1g} of it at most: the attractor stays passive, but "
            "passivity sets no bound to the sum of the changes.",
            "does not hold": "The swing grows in {bad} of {all} runs; in step with the motion K0 "
            "multiplies the peak by sqrt((r - 1)/2) each round.",
        },
    ),
)
