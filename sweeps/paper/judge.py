"""From a claim's table to its verdict: computed, never typed in."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import pandas as pd

from sweeps.paper.scenarios import LOCATED, Reading
from sweeps.paper.words import evaluated, rows

Verdict = Literal["holds", "holds where", "does not hold"]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and how it is measured."""

    id: str  # "C1"
    # One row for each scenario. A column `period` where control periods are compared, the paper's
    # first; a column `printed` where the paper speaks of some rows only; for a column of `good` a
    # column `..._trusted` where it may not be known.
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
        """Whether all its scenarios are known, and as claimed; an empty region proves nothing."""
        return bool(len(self) and (self.rows["good"] & self.rows["trusted"]).all())

    @property
    def counted(self) -> pd.DataFrame:
        """The scenarios that are known."""
        return self.rows[self.rows["trusted"]]

    @property
    def left_out(self) -> int:
        """How many scenarios are not."""
        return len(self.rows) - len(self.counted)

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Judgement:
    """A claim's table under one reading, and what follows from it.

    A claim holds where every scenario that the paper speaks of is as claimed. Otherwise it holds
    where the largest complete region is, and where one at another period is that covers still more.
    A scenario that is not known counts neither way, and a claim does not hold where one is.
    """

    claim: Claim
    table: pd.DataFrame  # with columns `good`, `trusted` and `printed`
    # The claim's scenarios as ode4 prints them, with its switches smeared over a step; None where
    # nothing is integrated.
    ode4: pd.DataFrame | None = None

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
    def whole(self) -> pd.DataFrame:
        """The scenarios that the paper speaks of."""
        return self.regions[0].rows

    @property
    def verdict(self) -> Verdict:
        """Whether the claim holds: everywhere, in a region, or in none."""
        if not self.where:
            return "does not hold"
        return "holds where" if any(self.where) else "holds"

    @property
    def score(self) -> float:
        """Share of the known scenarios the paper speaks of that are as claimed."""
        counted = self.regions[0].counted
        return float(counted["good"].mean()) if len(counted) else 0.0

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


def judge(claim: Claim, reading: Reading = LOCATED) -> Judgement:
    """Measure a claim under a reading, and mark the scenarios that are as claimed."""
    table = _marked(claim, claim.table(reading))
    if not reading.located:
        return Judgement(claim, table)
    ode4 = _marked(claim, claim.table(reading.as_printed()))
    same = table.loc[ode4.index, claim.measured].equals(ode4[claim.measured])
    return Judgement(claim, table, None if same else ode4)


def _marked(claim: Claim, table: pd.DataFrame) -> pd.DataFrame:
    """A claim's table with `printed`, `trusted` and `good`."""
    if "printed" not in table:
        own = table["period"] == table["period"].iloc[0] if "period" in table else True
        table = table.assign(printed=own)
    used = dict.fromkeys(f"{name}_trusted" for name in re.findall(r"\w+", claim.good))
    known = table[[name for name in used if name in table]].astype(bool).all(axis=1)
    return table.assign(trusted=known, good=evaluated(table, claim.good).astype(bool))
