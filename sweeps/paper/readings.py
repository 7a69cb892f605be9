"""The claims under every reading of the paper: law, divergence, peak, feedback, contact and "
"time."""

import itertools
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import xarray as xr

from fic_jax import CHOICES, Metrics, Model, Params, Sample
from sweeps.paper import contact, impact, quick, studies, welded
from sweeps.paper.judge import judge
from sweeps.paper.record import Claim, Judgement, Reading, Runner, Section

CHOSEN = ("law", "divergence", "peak", "feedback")  # what the paper leaves open of the controller
# period and plant step, s; contact. The first is what the paper prints.
SETTINGS = {
    "10 ms": (0.01, 0.01, "hard_stop"),
    "1 ms": (0.001, 0.001, "hard_stop"),
    "10 ms, dt 1 ms": (0.01, 0.001, "hard_stop"),
    "10 ms, damped rebound": (0.01, 0.01, "damped_rebound"),
}
CLAIMS = (*welded.CLAIMS, *contact.CLAIMS[:1], *impact.CLAIMS, *contact.CLAIMS[1:])
MODELS = tuple(
    Model(**dict(zip(CHOSEN, picked, strict=True)))  # type: ignore[arg-type]
    for picked in itertools.product(*(CHOICES[name] for name in CHOSEN))
)
REASON = 5.0  # percentage points of fit that would speak for another default
SHOWN = 12  # rows of the table
SIGNS = ("-", "(+)", "+")  # of the verdicts
VERDICTS = ("does not hold", "holds where", "holds")

Fields = dict[str, np.ndarray]
Key = tuple[tuple[str, bytes], ...]


class Asked:
    """The scenarios that claims ask for, welded or not: the same under every reading."""

    def __init__(self, claims: Iterable[Claim]) -> None:
        self.requests: dict[bool, dict[Key, Fields]] = {True: {}, False: {}}
        self.histories: Key = ()  # of one request, if any
        reading = Reading(runner=Runner(self._swept, self._rolled))
        for claim in claims:
            judge(claim, reading)
        for requests in self.requests.values():  # first what has histories
            order = sorted(requests, key=lambda key: key != self.histories)
            ordered = {key: requests[key] for key in order}
            requests.clear()
            requests.update(ordered)

    def _swept(self, fields: Fields, model: Model, dt: float) -> Metrics:
        self.requests[model.contact == "welded"][_key(fields)] = fields
        return studies.sweep_of(fields, model, dt)

    def _rolled(self, fields: Fields, model: Model, dt: float) -> Sample:
        self.histories = _key(fields)
        return studies.rollouts(fields, model, dt)

    def answered(self, reading: Reading) -> Runner:
        """A runner for one reading: all its scenarios in two programs, before anybody asks."""
        answers: dict[tuple[bool, Key], Metrics] = {}
        motions: dict[tuple[bool, Key], Sample] = {}
        for is_welded, requests in self.requests.items():
            if not requests:
                continue
            model = studies.with_contact(reading.model, "welded" if is_welded else None)
            sizes = [len(next(iter(fields.values()))) for fields in requests.values()]
            first = sizes[0] if next(iter(requests)) == self.histories else 1
            n_steps = round(studies.T_END / reading.dt)
            batch = _batch(requests.values(), sizes, reading.period)
            metrics, motion = quick.simulate(batch, model, reading.dt, n_steps, first)
            parts = [slice(end - n, end) for n, end in zip(sizes, np.cumsum(sizes), strict=True)]
            for key, part in zip(requests, parts, strict=True):
                answers[is_welded, key] = jax.tree.map(lambda leaf, p=part: leaf[p], metrics)
            motions[is_welded, next(iter(requests))] = motion
        return Runner(
            lambda fields, model, dt: answers[model.contact == "welded", _key(fields)],
            lambda fields, model, dt: motions[model.contact == "welded", _key(fields)],
        )


def _key(fields: Fields) -> Key:
    """Scenarios but for their period, which is the reading's."""
    return tuple((name, fields[name].tobytes()) for name in sorted(fields) if name != "period")


def _batch(requests: Iterable[Fields], sizes: Sequence[int], period: float) -> Params:
    """All requests, one after the other."""
    columns: dict[str, Any] = {}
    for name, default in vars(Params()).items():
        pairs = zip(requests, sizes, strict=True)
        columns[name] = np.concatenate([f.get(name, np.full(n, default)) for f, n in pairs])
    return Params(**columns | {"period": np.full(sum(sizes), period)})


def measure(
    models: Sequence[Model] = MODELS,
    claims: Sequence[Claim] = CLAIMS,
    settings: Sequence[str] = tuple(SETTINGS),
) -> xr.Dataset:
    """Share of the scenarios as claimed, and the verdict, for each reading, setting and claim."""
    asked = Asked(claims)

    def under(model: Model) -> list[list[Judgement]]:
        return [_judged(asked, claims, model, name) for name in settings]

    # Two at a time: a program is compiled by one core, and a short run keeps one busy.
    with ThreadPoolExecutor(2) as workers:
        judged = list(workers.map(under, models))
    over = ("model", "setting", "claim")
    return xr.Dataset(
        {
            "score": (over, [[[j.score for j in row] for row in rows] for rows in judged]),
            "verdict": (
                over,
                [[[VERDICTS.index(j.verdict) for j in row] for row in rows] for rows in judged],
            ),
        },
        coords={
            "model": [words(model) for model in models],
            "setting": list(settings),
            "claim": [claim.id for claim in claims],
        },
    )


def words(model: Model) -> str:
    """A reading in words."""
    return ", ".join(getattr(model, name).replace("_", " ") for name in CHOSEN)


def _judged(asked: Asked, claims: Sequence[Claim], model: Model, name: str) -> list[Judgement]:
    """The claims under a reading, in their order."""
    period, dt, kind = SETTINGS[name]
    reading = Reading(replace(model, contact=kind), period, dt)  # type: ignore[arg-type]
    reading = replace(reading, runner=asked.answered(reading))
    return [judge(claim, reading) for claim in claims]


def fit(data: xr.Dataset) -> xr.DataArray:
    """Mean share of scenarios as claimed over the claims, of each reading and setting."""
    return data["score"].mean("claim")


def section(data: xr.Dataset) -> Section:
    """Which readings fit best, and which claims none satisfies."""
    ranked = fit(data).stack(cell=("model", "setting"))
    ranked = ranked.isel(cell=np.argsort(-ranked.values, kind="stable"))
    default = [
        i for i, cell in enumerate(ranked["cell"].values) if cell == (words(Model()), "10 ms")
    ]
    shown = [*range(min(SHOWN, ranked.size)), *(i for i in default if i >= SHOWN)]
    claims = [str(claim) for claim in data["claim"].values]
    rows = []
    for i in shown:
        model, setting = ranked["cell"].values[i]
        cell = data.sel(model=model, setting=setting)
        signs = [SIGNS[int(v)] for v in cell["verdict"].values]
        shares = [
            f"{sign} {100 * s:.0f}" for sign, s in zip(signs, cell["score"].values, strict=True)
        ]
        name = f"**{model}** (default)" if i in default else model
        rows.append([f"{i + 1}", name, setting, f"{100 * float(ranked[i]):.0f} %", *shares])
    header = ("rank", "law, divergence, peak, feedback", "period, contact", "fit", *claims)
    text = _text(data, ranked, default)
    return Section(
        "The claims under every reading", text, header, rows, "readings", "fic-sweep report"
    )


def _text(data: xr.Dataset, ranked: xr.DataArray, default: list[int]) -> str:
    holds = data["verdict"] == VERDICTS.index("holds")
    never = ~holds.any(["model", "setting"])
    within = (data["verdict"] >= VERDICTS.index("holds where")).any(["model", "setting"])
    most = data["score"].max(["model", "setting"])

    def named(where: xr.DataArray) -> str:
        picked = [str(c) for c in data["claim"].values[where.values]]
        return ", ".join(f"{c} (at most {100 * float(most.sel(claim=c)):.0f} %)" for c in picked)

    best, setting = ranked["cell"].values[0]
    counts = holds.sum("claim")
    lead = 100 * (float(ranked[0]) - float(fit(data).sel(model=words(Model()), setting="10 ms")))
    own = data.sel(model=words(Model()), setting="10 ms")
    place = f"{default[0] + 1} of {ranked.size}" if default else "not run"
    alone = named(never & ~within) or "none"
    return (
        f"{ranked.size} combinations of law, divergence, peak, feedback, period and contact, each "
        f"judged by the {data.sizes['claim']} claims that depend on them. Fit is the share of "
        "scenarios as claimed, averaged over the claims; + holds, (+) holds under a condition, - "
        f"does not hold. Best is {best} at {setting}, fit {100 * float(ranked[0]):.0f} %; the "
        "default "
        f"is number {place}, fit {100 * float(own['score'].mean()):.0f} %, with "
        f"{int(holds.sel(model=words(Model()), setting='10 ms').sum())} claims that hold as "
        "printed "
        f"(the most under any: {int(counts.max())}). Its distance from the best is {lead:.1f} "
        "points: "
        f"{'no reason to change it' if lead < REASON else 'a reason to change it'}. "
        f"{_choices(data)}\n\n"
        f"Claims that no combination satisfies as printed: {named(never) or 'none'}; not even "
        "under "
        f"a condition: {alone}."
    )


def _choices(data: xr.Dataset) -> str:
    """What each choice does to the fit, all others averaged over."""
    whole = fit(data)
    choices = dict(
        zip(CHOSEN, np.array([str(m).split(", ") for m in data["model"].values]).T, strict=True)
    )
    parts = [
        _means(name, whole.groupby(xr.DataArray(of, dims="model", name=name)).mean(...))
        for name, of in choices.items()
    ]
    period = _means("period and contact", whole.mean("model"))
    return f"Mean fit by choice: {'; '.join([*parts, period])}."


def _means(name: str, means: xr.DataArray) -> str:
    options = means[means.dims[0]].values
    shares = (f"{o} {100 * float(m):.0f} %" for o, m in zip(options, means.values, strict=True))
    return f"{name} {', '.join(shares)}"
