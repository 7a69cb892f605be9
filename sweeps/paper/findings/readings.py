"""The claims under every reading of the paper: law, divergence, peak, feedback, contact, time."""

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pandas as pd
import xarray as xr

from fic_jax import CHOICES, Model
from sweeps.paper.claims import CLAIMS as EVERY
from sweeps.paper.judge import Claim, Judgement, judge
from sweeps.paper.scenarios import Reading

STORES = ()
CHOSEN = ("law", "divergence", "peak", "feedback")  # what the paper leaves open of the controller
# period and plant step, s; contact. The first is what the paper prints.
SETTINGS = {
    "10 ms": (0.01, 0.01, "hard_stop"),
    "1 ms": (0.001, 0.001, "hard_stop"),
    "10 ms, dt 1 ms": (0.01, 0.001, "hard_stop"),
    "10 ms, damped rebound": (0.01, 0.01, "damped_rebound"),
}
CLAIMS = EVERY[:10]  # those that depend on these choices
MODELS = tuple(
    Model(**dict(zip(CHOSEN, picked, strict=True)))  # type: ignore[arg-type]
    for picked in itertools.product(*(CHOICES[name] for name in CHOSEN))
)
SHOWN = 12  # rows of the table
SIGNS = ("-", "(+)", "+")  # of the verdicts
VERDICTS = ("does not hold", "holds where", "holds")


def measure(
    models: Sequence[Model] = MODELS,
    claims: Sequence[Claim] = CLAIMS,
    settings: Sequence[str] = tuple(SETTINGS),
) -> xr.Dataset:
    """Share of the scenarios as claimed, and the verdict, for each reading, setting and claim."""

    def under(model: Model) -> list[list[Judgement]]:
        return [[judge(claim, _reading(model, name)) for claim in claims] for name in settings]

    # Two at a time: a program is compiled by one core, and a short run occupies one.
    with ThreadPoolExecutor(2) as workers:
        judged = list(workers.map(under, models))
    cells = {
        "score": [[[j.score for j in row] for row in rows] for rows in judged],
        "verdict": [[[VERDICTS.index(j.verdict) for j in row] for row in rows] for rows in judged],
    }
    return xr.Dataset(
        {name: (("model", "setting", "claim"), values) for name, values in cells.items()},
        coords={
            "model": [words(model) for model in models],
            "setting": list(settings),
            "claim": [claim.id for claim in claims],
        },
    )


def _reading(model: Model, setting: str) -> Reading:
    period, dt, contact = SETTINGS[setting]
    return Reading(replace(model, contact=contact), period, dt)  # type: ignore[arg-type]


def words(model: Model) -> str:
    """A reading in words."""
    return ", ".join(getattr(model, name).replace("_", " ") for name in CHOSEN)


DEFAULT = (words(Model()), "10 ms")


def ranking(data: xr.Dataset) -> pd.DataFrame:
    """A row for each reading and setting, the best `fit` (percent) first.

    `fit` is the mean share of scenarios as claimed over the claims; `holds` counts the claims that
    hold as printed.
    """
    cells = (100 * data["score"].mean("claim")).to_dataframe("fit").reset_index()
    cells["holds"] = (data["verdict"] == VERDICTS.index("holds")).sum("claim").values.ravel()
    cells = cells.sort_values("fit", ascending=False, kind="stable", ignore_index=True)
    default = (cells["model"] == DEFAULT[0]) & (cells["setting"] == DEFAULT[1])
    return cells.assign(rank=cells.index + 1, default=default)


def lines(data: xr.Dataset) -> pd.DataFrame:
    """The readings that fit best, and the default, with the sign and share of each claim."""
    found = []
    for row in ranking(data).query(f"rank <= {SHOWN} or default").to_dict("records"):
        cell = data.sel(model=row["model"], setting=row["setting"])
        marks = {
            str(claim): f"{SIGNS[int(verdict)]} {100 * float(score):.0f}"
            for claim, verdict, score in zip(
                cell.claim.values, cell.verdict, cell.score, strict=True
            )
        }
        name = "**{model}** (default)" if row["default"] else "{model}"
        found.append(row | {"marks": marks, "name": name.format_map(row)})
    return pd.DataFrame(found)


def rows(data: xr.Dataset) -> pd.DataFrame:
    """`ranking`, with texts about the whole.

    `choices`: the mean fit of each option; `never`, `alone`: claims that no reading satisfies as
    printed, and not even under a condition.
    """
    ranked = ranking(data)
    best = (100 * data["score"]).max(["model", "setting"])
    verdict = data["verdict"].max(["model", "setting"])

    def below(level: str) -> str:
        short = best[verdict < VERDICTS.index(level)]
        return ", ".join(f"{s['claim'].item()} (at most {float(s):.0f} %)" for s in short) or "none"

    return ranked.assign(choices=_choices(ranked), never=below("holds"), alone=below("holds where"))


def _choices(ranked: pd.DataFrame) -> str:
    """Mean fit of each option, all other choices averaged over."""
    cells = ranked.sort_index()
    cells[list(CHOSEN)] = cells["model"].str.split(", ", expand=True)
    texts = []
    for name in (*CHOSEN, "setting"):
        means = cells.groupby(name)["fit"].mean()
        order = SETTINGS if name == "setting" else means.index
        shares = ", ".join(f"{option} {means[option]:.0f} %" for option in order if option in means)
        texts.append(f"{name.replace('setting', 'period and contact')} {shares}")
    return "; ".join(texts)
