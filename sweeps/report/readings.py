"""The claims under every reading of the paper: law, divergence, peak, feedback, contact and "
"time."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import xarray as xr

from fic_jax import CHOICES, Metrics, Model, Params, Sample
from sweeps.report import contact, impact, quick, studies, welded
from sweeps.report.judge import judge
from sweeps.report.record import Claim, Judgement, Reading, Runner, Section

CHOSEN = ("law", "divergence", "peak", "feedback")  # what the paper leaves open of the controller
# period and plant step, s; contact. The first is what the paper prints; a finer plant step and the
# other stop only for the first options of `peak` and `feedback`, as compiling is what takes time.
SETTINGS = {
    "10 ms": (0.01, 0.01, "hard_stop"),
    "1 ms": (0.001, 0.001, "hard_stop"),
    "10 ms, dt 1 ms": (0.01, 0.001, "hard_stop"),
    "10 ms, damped rebound": (0.01, 0.01, "damped_rebound"),
}
FULL = tuple(SETTINGS)[:2]
CLAIMS = (*welded.CLAIMS, *contact.CLAIMS[:1], *impact.CLAIMS, *contact.CLAIMS[1:])
MODELS = tuple(
    Model(**dict(zip(CHOSEN, picked, strict=True)))  # type: ignore[arg-type]
    for picked in itertools.product(*(CHOICES[name] for name in CHOSEN))
)
SHOWN = 12  # rows of the table
SIGNS = ("-", "(+)", "+")  # of the verdicts
VERDICTS = ("does not hold", "holds where", "holds")

Fields = dict[str, np.ndarray]
Key = tuple[tuple[str, bytes], ...]


class Asked:
    """The scenarios that claims ask for, welded or not: the same under every reading."""

    def __init__(self, claims: Iterable[Claim]) -> None:
        self.requests: dict[bool, dict[Key, Fields]] = {True: {}, False: {}}
        reading = Reading(runner=Runner(self._swept, self._rolled))
        for claim in claims:
            judge(claim, reading)

    def _swept(self, fields: Fields, model: Model, dt: float) -> Metrics:
        self.requests[model.contact == "welded"][_key(fields)] = fields
        return studies.sweep_of(fields, model, dt)

    def _rolled(self, fields: Fields, model: Model, dt: float) -> Sample:
        return studies.rollouts(fields, model, dt)  # of scenarios that a sweep asks for as well

    def answered(self, reading: Reading) -> Runner:
        """A runner for one reading: all its scenarios in two programs, before anybody asks."""
        answers: dict[tuple[bool, Key], tuple[Metrics, Sample]] = {}
        for welded_ in (True, False):
            model = studies.with_contact(reading.model, "welded" if welded_ else None)
            answers |= {
                (welded_, key): answer
                for key, answer in _simulated(self.requests[welded_], reading, model)
            }

        def metrics(fields: Fields, model: Model, dt: float) -> Metrics:
            return answers[model.contact == "welded", _key(fields)][0]

        def histories(fields: Fields, model: Model, dt: float) -> Sample:
            return answers[model.contact == "welded", _key(fields)][1]

        return Runner(metrics, histories)


def _key(fields: Fields) -> Key:
    """Scenarios but for their period, which is the reading's."""
    return tuple((name, fields[name].tobytes()) for name in sorted(fields) if name != "period")


def _simulated(
    requests: dict[Key, Fields], reading: Reading, model: Model
) -> Iterator[tuple[Key, tuple[Metrics, Sample]]]:
    """Every request answered from one batch."""
    sizes = [len(next(iter(fields.values()))) for fields in requests.values()]
    columns: dict[str, Any] = {}
    for name, default in vars(Params()).items():
        pairs = zip(requests.values(), sizes, strict=True)
        columns[name] = np.concatenate([f.get(name, np.full(n, default)) for f, n in pairs])
    columns["period"] = np.full(sum(sizes), reading.period)
    n_steps = round(studies.T_END / reading.dt)
    result = quick.simulate(Params(**columns), model, reading.dt, n_steps)
    ends = np.cumsum(sizes)
    for key, end, size in zip(requests, ends, sizes, strict=True):
        # copies: a view would keep the whole batch
        yield key, jax.tree.map(lambda leaf, part=slice(end - size, end): leaf[part].copy(), result)


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
    shape = (len(models), len(settings), len(claims))
    score, verdict = np.full((2, *shape), np.nan)
    for i, j in np.ndindex(shape[:2]):
        for k, judgement in enumerate(judged[i][j]):
            score[i, j, k] = judgement.score
            verdict[i, j, k] = VERDICTS.index(judgement.verdict)
    over = ("model", "setting", "claim")
    return xr.Dataset(
        {"score": (over, score), "verdict": (over, verdict)},
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
    """The claims under a reading; none where this setting is not run."""
    usual = (model.peak, model.feedback) == (Model().peak, Model().feedback)
    if name not in FULL and not usual:
        return []
    period, dt, kind = SETTINGS[name]
    reading = Reading(replace(model, contact=kind), period, dt)  # type: ignore[arg-type]
    reading = replace(reading, runner=asked.answered(reading))
    return [judge(claim, reading) for claim in claims]


def fit(data: xr.Dataset) -> xr.DataArray:
    """Mean share of scenarios as claimed over the claims, of each reading and setting."""
    return data["score"].mean("claim")


def section(data: xr.Dataset) -> Section:
    """Which readings fit best, and which claims none satisfies."""
    ranked = fit(data).stack(cell=("model", "setting")).dropna("cell")
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
    counts = holds.sum("claim").where(data["score"].notnull().all("claim"))
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
        f"(the most under any: {int(counts.max())}). {_choices(data)}\n\n"
        f"Claims that no combination satisfies as printed: {named(never) or 'none'}; not even "
        "under "
        f"a condition: {alone}."
    )


def _choices(data: xr.Dataset) -> str:
    """What each choice does to the fit, all others averaged over."""
    whole = fit(data).sel(setting=[name for name in FULL if name in data["setting"].values])
    choices = dict(
        zip(CHOSEN, np.array([str(m).split(", ") for m in data["model"].values]).T, strict=True)
    )
    parts = [
        _means(name, whole.groupby(xr.DataArray(of, dims="model", name=name)).mean(...))
        for name, of in choices.items()
    ]
    period = _means("period", whole.mean("model"))
    return f"Mean fit by choice: {'; '.join([*parts, period])}."


def _means(name: str, means: xr.DataArray) -> str:
    options = means[means.dims[0]].values
    shares = (f"{o} {100 * float(m):.0f} %" for o, m in zip(options, means.values, strict=True))
    return f"{name} {', '.join(shares)}"
