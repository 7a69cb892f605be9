"""The claims under every reading of the paper: the choices of the controller, and of the program.

The old choices (law, divergence, peak, feedback) are combined with each other. How Simulink would
run the search, and what x~ means in Algorithm 2, are combined with each other and with the law. As
the paper ran welded studies with ode4 and contact with a variable step, so do some readings.
"""

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from fic_jax import CHOICES, Model
from sweeps.paper.claims import CLAIMS as EVERY
from sweeps.paper.judge import Claim, Judgement, judge
from sweeps.paper.scenarios import Reading
from sweeps.paper.words import rows as rows_of

STORES = ()
CHOSEN = ("law", "divergence", "peak", "feedback")  # what the paper leaves open of the controller
# A control period, its plant step of 1 ms fine enough to show the motion. The first is the paper's.
PERIODS: dict[str, dict[str, Any]] = {
    "10 ms": {"period": 0.01, "dt": 0.001},
    "1 ms": {"period": 0.001, "dt": 0.001},
    "10 ms, damped rebound": {"period": 0.01, "dt": 0.001},
}
STAGES: dict[str, dict[str, Any]] = {
    "stages of ode4": {"clock": "stages"},
    "stages of ode4, both algorithms": {"clock": "both at stages"},
}
STEPS: dict[str, dict[str, Any]] = {
    f"steps of {clock}, {rtol:.0e}{', mean of samples' if mean == 'samples' else ''}": {
        "clock": clock,
        "rtol": rtol,
        "mean": mean,
    }
    for clock in ("RK23", "RK45", "ode23s")
    for rtol in (1e-3, 1e-6)
    for mean in ("time", "samples")
}
SETTINGS = PERIODS | STAGES | STEPS


def _where(table: Callable[[Reading], pd.DataFrame], query: str, reading: Reading) -> pd.DataFrame:
    return rows_of(table(reading), query)


CLAIMS = EVERY[:10]  # those that depend on these choices
WELDED = ("C1", "C2", "C3", "C4")  # what the paper ran with ode4; the others with ode23t
# Parts of claims, which no fit counts: the halves of C1 where Td can be reached and K0 is one of
# the captions', and the first half of C5.
PARTS = tuple(
    replace(claim, id=id, good=good, conditions=[], table=partial(_where, claim.table, query))
    for claim, id, good, query in (
        (EVERY[0], "C1 run", "nmse <= 1e-1", "K0 >= 1 and Td <= Fmax"),
        (EVERY[0], "C1 tail", "nmse_tail <= 1e-4", "K0 >= 1 and Td <= Fmax"),
        (EVERY[4], "C5 tail", "0.1/10**0.5 <= nmse_tail <= 0.1*10**0.5", "Td <= Fmax"),
    )
)
BOTH = "; not welded: "  # between the settings of ode4 and of a variable-step solver
SHOWN = 12  # rows of the table
SIGNS = ("-", "(+)", "+")  # of the verdicts
VERDICTS = ("does not hold", "holds where", "holds")


@dataclass(frozen=True)
class Choice:
    """A reading and its name in the table."""

    model: Model
    setting: str

    @property
    def reading(self) -> Reading:
        contact = "damped_rebound" if "damped" in self.setting else "hard_stop"
        return Reading(replace(self.model, contact=contact), **SETTINGS[self.setting])  # type: ignore[arg-type]


def _models(*axes: str) -> list[Model]:
    picks = itertools.product(*(CHOICES[name] for name in axes))
    return [Model(**dict(zip(axes, picked, strict=True))) for picked in picks]  # type: ignore[arg-type]


def _every() -> tuple[Choice, ...]:
    old = [Choice(m, s) for m in _models(*CHOSEN) for s in PERIODS]
    new = [
        Choice(m, s)
        for m in _models("law", "expectation")
        for s in SETTINGS
        if s not in PERIODS or m.expectation == "error"
    ]
    return (*old, *new)


CHOICES_TRIED = _every()
DEFAULT = Choice(Model(), "10 ms")


@lru_cache(maxsize=2)
def measure(
    choices: Sequence[Choice] = CHOICES_TRIED, claims: Sequence[Claim] = CLAIMS
) -> xr.Dataset:
    """Share of the scenarios that are trusted and as claimed, share trusted, and the verdict.

    For each reading and claim. A scenario that is not trusted explains nothing.
    """

    ids = [claim.id for claim in (*claims, *PARTS)]

    def under(choice: Choice) -> list[tuple[float, float, int]]:
        return [_seen(judge(claim, choice.reading)) for claim in (*claims, *PARTS)]

    # Two at a time: a program is compiled by one core, and a short run occupies one.
    with ThreadPoolExecutor(2) as workers:
        found = (np.array(cells) for cells in workers.map(under, choices))
        judged = dict(zip(choices, found, strict=True))
    by_ode4 = np.array([id.split()[0] in WELDED for id in ids])
    for one, other in itertools.product(choices, choices):
        if one.setting in STAGES and other.setting in STEPS and one.model == other.model:
            both = np.where(by_ode4[:, None], judged[one], judged[other])
            judged[Choice(one.model, f"{one.setting}{BOTH}{other.setting}")] = both
    cells = np.array(list(judged.values()))
    names = ("score", "trusted", "verdict")
    return xr.Dataset(
        {name: (("reading", "claim"), cells[:, :, i]) for i, name in enumerate(names)},
        coords={
            "reading": [name(choice) for choice in judged],
            "model": ("reading", [words(choice.model) for choice in judged]),
            "expectation": ("reading", [choice.model.expectation for choice in judged]),
            "setting": ("reading", [choice.setting for choice in judged]),
            "claim": ids,
        },
    )


def _seen(judged: Judgement) -> tuple[float, float, int]:
    """Share trusted and as claimed, share trusted, and the verdict."""
    rows = judged.whole
    good = float((rows["good"] & rows["trusted"]).mean())
    return good, float(rows["trusted"].mean()), VERDICTS.index(judged.verdict)


def claims_alone(data: xr.Dataset) -> xr.Dataset:
    """The data without the parts of claims."""
    return data.sel(claim=[id for id in data["claim"].values if " " not in str(id)])


def words(model: Model) -> str:
    """The old choices of a reading."""
    return ", ".join(getattr(model, axis).replace("_", " ") for axis in CHOSEN)


def name(choice: Choice) -> str:
    """A reading in words."""
    expectation = ", x~ the error" if choice.model.expectation == "error" else ""
    return f"{words(choice.model)}{expectation}; {choice.setting}"


def ranking(data: xr.Dataset) -> pd.DataFrame:
    """A row for each reading, the best `fit` (percent) first.

    `fit` is the mean share of scenarios as claimed over the claims; `holds` counts the claims that
    hold as printed, `where` those that hold at least under a condition.
    """
    data = claims_alone(data)
    cells = pd.DataFrame(
        {
            "reading": data["reading"].values,
            "model": data["model"].values,
            "expectation": data["expectation"].values,
            "setting": data["setting"].values,
            "fit": 100 * data["score"].mean("claim").values,
            "holds": (data["verdict"] == VERDICTS.index("holds")).sum("claim").values,
            "where": (data["verdict"] > 0).sum("claim").values,
            "trusted": 100 * data["trusted"].mean("claim").values,
        }
    )
    cells = cells.sort_values("fit", ascending=False, kind="stable", ignore_index=True)
    return cells.assign(rank=cells.index + 1, default=cells["reading"] == name(DEFAULT))


def lines(data: xr.Dataset) -> pd.DataFrame:
    """The best readings, the best of each way to run all studies, and the default."""
    data = claims_alone(data)
    ranked, found = ranking(data), []
    alike = ~ranked["setting"].str.contains(BOTH)
    best = ranked[alike].drop_duplicates(["setting", "expectation"]).index
    shown = (ranked["rank"] <= SHOWN) | ranked["default"] | ranked.index.isin(best)
    for row in ranked[shown].to_dict("records"):
        cell = data.sel(reading=row["reading"])
        marks = {
            str(claim): f"{SIGNS[int(verdict)]} {100 * float(score):.0f}"
            for claim, verdict, score in zip(
                cell.claim.values, cell.verdict, cell.score, strict=True
            )
        }
        text = f"**{row['model']}** (default)" if row["default"] else row["model"]
        found.append(row | {"marks": marks, "name": text})
    return pd.DataFrame(found)


def rows(data: xr.Dataset) -> pd.DataFrame:
    """`ranking`, with texts about the whole.

    `choices`: the mean fit of each option; `never`, `alone`: claims that no reading satisfies as
    printed, and not even under a condition.
    """
    data = claims_alone(data)
    ranked = ranking(data)
    best = (100 * data["score"]).max("reading")
    verdict = data["verdict"].max("reading")

    def below(level: str) -> str:
        short = best[verdict < VERDICTS.index(level)]
        return ", ".join(f"{s['claim'].item()} (at most {float(s):.0f} %)" for s in short) or "none"

    return ranked.assign(choices=_choices(ranked), never=below("holds"), alone=below("holds where"))


def _choices(ranked: pd.DataFrame) -> str:
    """Mean fit of each option, all other choices averaged over."""
    full = ranked[ranked["setting"].isin(PERIODS) & (ranked["expectation"] == "displacement")]
    texts = []
    for axis, options in zip(CHOSEN, zip(*full["model"].str.split(", "), strict=True), strict=True):
        means = full.groupby(list(options))["fit"].mean()
        texts.append(f"{axis} {_shares(means, means.index)}")
    means = full.groupby("setting")["fit"].mean()
    texts.append(f"period and contact {_shares(means, PERIODS)}")
    new = ranked[~ranked["setting"].isin(PERIODS)]
    means = new.groupby("expectation")["fit"].mean()
    texts.append(f"x~ as Simulink would run it {_shares(means, means.index)}")
    return "; ".join(texts)


def _shares(means: pd.Series, order: Any) -> str:
    return ", ".join(f"{option} {means[option]:.0f} %" for option in order if option in means)
