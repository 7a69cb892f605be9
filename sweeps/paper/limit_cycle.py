"""Where the loop never settles, and the boundary of that region from the loop's own formula."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from fic_jax import Metrics, Model, Params, sweep, trusted
from sweeps.paper import formulas, loop
from sweeps.paper.record import Section

DT = 1e-3  # s; finer than the printed 10 ms, so that the plant's integration is not the matter
T_END = 20.0  # s; the tail is what is left after the paper's 10 s
N_STEPS = round(T_END / DT)
SWING = 1e-2  # root mean square of T about its mean, over T_n, that counts as a limit cycle
LASTING = 0.25  # of its swing over 5 to 10 s that it must keep: what fades is none
SWITCHES = 10  # of Algorithm 1 after 10 s, at least: a slow approach has none
STRIPE = np.arange(25.0, 50.0, 0.25)  # N*m/rad, about the stripe
KEPT = 100.0  # factor of nmse_tail by which a stripe stands out

READINGS = {
    "algorithm1, welded": Model(contact="welded"),
    "algorithm1, hard stop": Model(),
    "effort, welded": Model(law="effort", contact="welded"),
}
K0 = np.geomspace(1.0, 1000.0, 37)
PERIODS = 1e-3 * np.array([1, 2, 3, 5, 7, 10, 14, 20, 25, 32, 40, 50, 63, 79, 100, 126, 158, 200])
SIGMAS = np.geomspace(1e-4, 1.0, len(PERIODS))


@dataclass(frozen=True)
class Map:
    """Scenarios over K0 and one other field, all else the paper's but for `Denv`."""

    field: str
    values: np.ndarray
    Denv: float

    def params(self, K0: np.ndarray) -> Params:
        """Every cell, flat, K0 along the first side."""
        grid = dict(
            zip(("K0", self.field), np.meshgrid(K0, self.values, indexing="ij"), strict=True)
        )
        return Params(**{name: side.ravel() for name, side in grid.items()}, Denv=self.Denv)


MAPS = {
    "period": Map("period", PERIODS, 189.7),
    "sigma": Map("sigma", SIGMAS, 189.7),
    "period, light damping": Map("period", PERIODS, 20.0),
}


def measure(
    K0: np.ndarray = K0,
    maps: dict[str, Map] = MAPS,
    readings: dict[str, Model] = READINGS,
    stripe_K0: np.ndarray = STRIPE,
) -> xr.Dataset:
    """Limit cycles measured and predicted on each map, and the stripe of Algorithm 1."""
    batch = _joined([m.params(K0) for m in maps.values()])
    over = ("map", "K0", "step")
    shape = (len(maps), len(K0), -1)
    observed = [_observed(batch, model) for model in readings.values()]
    found = {
        name: (("reading", *over), np.stack([each[name].reshape(shape) for each in observed]))
        for name in observed[0]
    }
    predicted = {name: (over, cells.reshape(shape)) for name, cells in predictions(batch).items()}
    sides = {
        "value": (("map", "step"), np.stack([m.values for m in maps.values()])),
        "field": ("map", [m.field for m in maps.values()]),
        "Denv": ("map", [m.Denv for m in maps.values()]),
    }
    names = {"reading": list(readings), "map": list(maps), "K0": K0}
    extra = {"trusted": (("K0", "step"), _trusted(next(iter(maps.values())).params(K0), len(K0)))}
    return xr.Dataset({**found, **predicted, **extra, **_stripe(stripe_K0)}, coords=names | sides)


def _trusted(batch: Params, rows: int) -> np.ndarray:
    """Whether the first reading's numbers of the first map can be trusted, [K0, step]."""
    model = next(iter(READINGS.values()))
    single = _joined([batch])
    metrics, errors = sweep(single, model=model, dt=DT, n_steps=N_STEPS, error_estimate=True)
    return np.asarray(trusted(metrics, errors)).reshape(rows, -1)


def _joined(parts: list[Params]) -> Params:
    """One batch of several, in single precision."""
    columns: dict[str, Any] = {}
    for name in vars(parts[0]):
        sizes = [len(np.ravel(part.K0)) for part in parts]
        pairs = zip(parts, sizes, strict=True)
        columns[name] = np.concatenate([np.broadcast_to(getattr(p, name), n) for p, n in pairs])
    return Params(**{name: column.astype(np.float32) for name, column in columns.items()})


def _observed(batch: Params, model: Model) -> dict[str, np.ndarray]:
    """By what the joint does, no formula: does T keep swinging, did the joint turn at all."""
    whole = sweep(batch, model=model, dt=DT, n_steps=N_STEPS)
    half = sweep(batch, model=model, dt=DT / 2, n_steps=N_STEPS)  # the same program, for 10 s
    swing, late = _swing(whole), whole.mode_switches - half.mode_switches
    lasts = (swing > SWING) & (swing > LASTING * _swing(half)) & (late >= SWITCHES)
    # one switch comes with setting off: a turn is another
    return {"cycles": lasts, "turned": whole.mode_switches > 1}


def _swing(metrics: Metrics) -> np.ndarray:
    """Root mean square of T about its mean over the tail, over T_n."""
    return np.asarray(np.sqrt(np.maximum(metrics.nmse_tail - metrics.steady_error**2, 0.0)))


def predictions(p: Params) -> dict[str, np.ndarray]:
    """What the formulas say of each scenario.

    `closed`: K0 below `formulas.overshoot_stiffness`. `linear`: the sampled linear loop turns, and
    the joint started with more than Td. `unstable`: one of the loop's branches at rest is.
    """
    excess, _, _ = loop.first_branch(p)
    turns, _ = loop.response(loop.starting(p), T_END)
    radius = [loop.resting(p, branch).spectral_radius() for branch in ("diverging", "converging")]
    return {
        "closed": formulas.overshoot_stiffness(p) > p.K0,
        "turns": turns,
        "linear": turns & (excess > 1.0 + 1e-6),
        "unstable": np.maximum(*radius) > 1.0,
    }


def _stripe(K0: np.ndarray) -> dict[str, Any]:
    """nmse_tail along K0 at the printed period, for the law as printed and for `effort`."""
    models = Model(contact="welded"), Model(law="effort", contact="welded")
    batch = _joined([Params(K0=K0)])
    runs = [sweep(batch, model=model, dt=DT, n_steps=N_STEPS) for model in models]
    return {
        "stripe_K0": ("along", K0),
        "stripe_tail": (("law", "along"), np.stack([run.nmse_tail for run in runs]).astype(float)),
        "stripe_ends": ("end", np.array(formulas.stripe(Params()))),
        "law": ("law", [model.law for model in models]),
    }


def confusion(predicted: np.ndarray, measured: np.ndarray) -> tuple[float, float, float]:
    """Shares of the cells: right, predicted but not measured, measured but not predicted."""
    right = float(np.mean(predicted == measured))
    return right, float(np.mean(predicted & ~measured)), float(np.mean(~predicted & measured))


def outstanding(data: xr.Dataset) -> np.ndarray:
    """K0 of the stripe: where the printed law is worse than `effort` by more than KEPT."""
    printed, effort = data["stripe_tail"].values
    return np.asarray(data["stripe_K0"].values[printed > KEPT * effort])


def _light(data: xr.Dataset) -> str:
    """What is left of it where the inertia, which the closed form neglects, makes the joint "
    "turn."""
    name = "period, light damping"
    if name not in data["map"].values:
        return ""
    light = data.sel(map=name).isel(reading=0)
    turned, cycles = (light[n].values.astype(bool) for n in ("turned", "cycles"))
    closed, linear = (
        confusion(light[n].values.astype(bool), cycles)[0] for n in ("closed", "linear")
    )
    return (
        f" With Denv = {float(light['Denv']):g} the inertia, which the closed form neglects, makes "
        f"the joint turn in {100 * turned.mean():.0f} % of the cells: there the closed form is "
        "right "
        f"in {100 * closed:.1f} %, the sampled linear loop with r > 1 in {100 * linear:.1f} % "
        "(welded)."
    )


def _at_rest(cells: xr.Dataset) -> str:
    """What the eigenvalues of the loop at rest say, and why that is not the answer."""
    unstable, cycles = (cells[name].values.astype(bool) for name in ("unstable", "cycles"))
    right, false, _ = confusion(unstable, cycles)
    return (
        "The eigenvalues of the loop about its rest alone do not tell: the diverging branch is as "
        "steep as dF_K/de there, and where that lies beyond x0 the sampled loop is unstable in "
        f"{100 * unstable.mean():.0f} % of the cells, {100 * false:.0f} % without a limit cycle "
        f"({100 * right:.0f} % right): a joint that does not overshoot approaches on the "
        "converging "
        "branch and never meets the other."
    )


def _trust(data: xr.Dataset) -> str:
    """Which cells a plant step half as long would change."""
    first = data.isel(reading=0, map=0)
    cycles, doubt = first["cycles"].values.astype(bool), ~data["trusted"].values.astype(bool)
    inside, outside = (f"{100 * doubt[part].mean():.3g} %" for part in (cycles, ~cycles))
    return (
        f"The error estimate distrusts {inside} of the cells with a limit cycle and {outside} of "
        f"the others ({first['reading'].item()}, {first['map'].item()}): it tells whether a finer "
        "plant step changes nmse, which that of a regular limit cycle stands.\n\n"
    )


def section(data: xr.Dataset) -> Section:
    """Where it never settles, and how well the formula tells."""
    rows = []
    for reading in data["reading"].values:
        for name in data["map"].values:
            cells = data.sel(reading=reading, map=name)
            cycles = cells["cycles"].values.astype(bool)
            told = [confusion(cells[f].values.astype(bool), cycles) for f in ("closed", "linear")]
            shown = [
                f"{100 * right:.1f} % ({100 * false:.1f}, {100 * missed:.1f})"
                for right, false, missed in told
            ]
            rows.append((str(reading), str(name), f"{100 * cycles.mean():.1f} %", *shown))
    header = (
        "reading",
        "map",
        "limit cycle",
        "closed form right (false, missed)",
        "sampled linear loop right (false, missed)",
    )
    return Section(
        "Where the loop limit-cycles",
        _text(data),
        header,
        rows,
        "limit_cycle",
        "fic-sweep report",
    )


def _text(data: xr.Dataset) -> str:
    printed = data.sel(reading="algorithm1, welded", map="period")
    effort = data.sel(reading="effort, welded", map="period")
    turned = confusion(effort["turns"].values.astype(bool), effort["turned"].values.astype(bool))
    closed = confusion(printed["closed"].values.astype(bool), printed["cycles"].values.astype(bool))
    low, high = data["stripe_ends"].values
    found = outstanding(data)
    return (
        "Where K0 is soft (Td/K0 > x0) the joint starts with r = F_K(Td/K0)/Td times the desired "
        "torque. The first branch of Algorithm 1 is linear; with the inertia neglected the joint "
        "overshoots and turns where\n\n"
        "    K0 < (r - 1)/(2 r) (Kenv - 2 sigma Denv/period)\n\n"
        "and each turn latches a new peak error and throws the torque back up. So it is a *long* "
        "period that limit-cycles, not a short one: the search is too slow to take the excess back "
        "before the joint has gone too far. Measured, independently of any formula: T swings by "
        f"more than {100 * SWING:g} % rms over 10 to 20 s, no less than {LASTING:g} of its swing "
        f"over 5 to 10 s, with at least {SWITCHES} switches of Algorithm 1. On K0 by period the "
        f"closed form is right in {100 * closed[0]:.1f} % of the cells. Whether the joint turns at "
        f"all the sampled linear loop tells right in {100 * turned[0]:.1f} % (law `effort`, whose "
        "branch is linear throughout); turning is necessary for a limit cycle and not sufficient, "
        f"as the latched error shrinks with each turn and may come below x0.{_light(data)}\n\n"
        f"{_at_rest(printed)}\n\n{_trust(data)}"
        f"**The stripe at K0 = {found.min():.3g} to {found.max():.3g}** (Td = 5) is no limit cycle "
        "of the search but of the printed law: its slope jumps at |e| = x0, and where the rest of "
        "each side lies on the other side there is none. The two rests coincide with x0 at K0 = "
        f"{low:.4g}, which is (1/2 + 1/(2 r)) Td/x0, and {high:.4g}; with law `effort`, one slope, "
        "the stripe is gone."
    )
