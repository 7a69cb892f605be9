"""From a claim's table to its verdict: computed, never typed in."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import pandas as pd

from sweeps.paper.scenarios import PRINTED, Reading
from sweeps.paper.words import evaluated, rows

Verdict = Literal["holds", "holds where", "does not hold"]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and how it is measured."""

    id: str  # "C1"
    # One row for each scenario. A column `period` where control periods are compared, the paper's
    # first; a column `printed` where the paper speaks of some rows only.
    table: Callable[[Reading], pd.DataFrame]
    by: list[str]  # columns that name a scenario
    measured: list[str]  # columns that the report shows
    good: str  # query: a scenario is as claimed
    conditions: list[str]  # queries: parts of the scenarios in which the claim may hold


@dataclass(frozen=True)
class Region:
    """Scenarios in which a claim is tried."""

    query: str  # empty: all that the paper speaks of
    period: str  # query for a control period that the paper does not print, else empty
    rows: pd.DataFrame

    def complete(self) -> bool:
        """Whether all its scenarios are as claimed; an empty region proves nothing."""
        return bool(len(self) and self.rows["good"].all())

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Judgement:
    """A claim's table under one reading, and what follows from it.

    A claim holds where every scenario that the paper speaks of is as claimed. Otherwise it holds
    where the largest complete region is, and where one at another period is that covers still more.
    """

    claim: Claim
    table: pd.DataFrame  # with columns `good` and `printed`

    @cached_property
    def regions(self) -> list[Region]:
        """The paper's scenarios, their parts, then the same at each other period."""
        own, others = self.table, []
        if "period" in own:
            first, *others = own["period"].unique()
            own = own[own["period"] == first]
        found = [Region("", "", rows(own, "printed"))]
        found += [Region(part, "", rows(own, part)) for part in self.claim.conditions]
        for period in (f"period == {value:g}" for value in others):
            for query in (period, *(f"{period} and {part}" for part in self.claim.conditions)):
                found.append(Region(query, period, rows(self.table, query)))
        return found

    @cached_property
    def where(self) -> list[str]:
        """Queries under which the claim holds; [""] if it holds everywhere."""
        whole, *parts = self.regions
        if whole.complete():
            return [""]
        own = max((r for r in parts if r.complete() and not r.period), key=len, default=None)
        other = max((r for r in parts if r.complete() and r.period), key=len, default=None)
        if own and other and len(other) <= len(own):
            other = None
        return [region.query for region in (own, other) if region]

    @property
    def verdict(self) -> Verdict:
        """Whether the claim holds: everywhere, in a region, or in none."""
        if not self.where:
            return "does not hold"
        return "holds where" if any(self.where) else "holds"

    @property
    def score(self) -> float:
        """Share of the scenarios the paper speaks of that are as claimed."""
        return float(self.regions[0].rows["good"].mean())

    def shown(self) -> list[Region]:
        """Regions worth a line of the report.

        Of the paper's period the whole, and the parts if the whole is not complete; of another
        period the whole and the largest complete part.
        """
        first, shown = self.regions[0], []
        for region in filter(len, self.regions):
            alike = [r for r in self.regions if r.period == region.period and r.complete()]
            if region.period:
                worth = region.query == region.period or region is max(alike, key=len, default=None)
            else:
                inside = region.rows.index.isin(first.rows.index).all()
                worth = region is first or not inside or not first.complete()
            if worth:
                shown.append(region)
        return shown


def judge(claim: Claim, reading: Reading = PRINTED) -> Judgement:
    """Measure a claim under a reading, and mark the scenarios that are as claimed."""
    table = claim.table(reading)
    if "printed" not in table:
        own = table["period"] == table["period"].iloc[0] if "period" in table else True
        table = table.assign(printed=own)
    return Judgement(claim, table.assign(good=evaluated(table, claim.good)))
