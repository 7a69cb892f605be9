"""What stands on a report's page, before it is Markdown or HTML: records and tables of text."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sweeps.paper.record import Condition, Findings, Judgement, Section

MOST_ROWS = 30  # of a table of scenarios

INTRODUCTION = (
    "The claims of Tiseo et al., Bio-mimetic Adaptive Force/Position Control Using Fractal "
    "Impedance (2020), held against simulations of the equations and algorithms as printed. Each "
    "verdict is computed from the numbers beside it. Quantities are in N, m, rad, s and kg; K0, "
    "Td, Fmax, ... are the paper's symbols, figures go by their labels in its source; nmse "
    "is the mean of ((T - Td)/min(Td, Fmax))². The printed reading has a plant step and a control "
    "period of 10 ms, the step that the paper names; it gives no control period, and the claims "
    "are also tried at 1, 2 and 5 ms."
)
SIGNS = {"N*m*s": "N·m·s", "<=": "≤", ">=": "≥", "N*m": "N·m", "sqrt": "√"}


@dataclass(frozen=True)
class Table:
    """Texts in rows below a header."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Page:
    """A whole report. Pictures are named by their stems."""

    judgements: Sequence[Judgement]
    sections: Sequence[Section]
    provenance: Mapping[str, str]
    pictures: Sequence[str]  # stems of those that were drawn

    def picture(self, stem: str) -> bool:
        """Whether there is a picture of this name."""
        return stem in self.pictures


def claims_table(page: Page) -> Table:
    """One row for each claim."""
    rows = [
        (j.claim.id, j.claim.title, j.words, f"{100 * j.score:.0f} %", j.key)
        for j in page.judgements
    ]
    return Table(("", "claim", "verdict", "scenarios as claimed", "measured"), rows)


def conditions_table(findings: Findings) -> Table:
    """How much of each condition is as claimed, and the range of every quantity there.

    Parts only where the whole is not as claimed; of other periods than the printed one the whole
    and the widest part that is.
    """
    shown = [c for c in findings.conditions if c.where.any() and _shown(c, findings)]
    header = (
        "where",
        "scenarios",
        "as claimed",
        *(_titled(e.quantity, e.bound) for e in findings.evidence),
    )
    good = findings.good()
    rows = [
        (
            condition.words or "as the paper has it",
            str(int(condition.where.sum())),
            str(int(good[condition.where].sum())),
            *(_range(e.values[condition.where]) for e in findings.evidence),
        )
        for condition in shown
    ]
    return Table(header, rows)


def _shown(condition: Condition, findings: Findings) -> bool:
    """All of the printed reading; of another period the whole, and the widest that is good."""
    printed, good = findings.conditions[0].where, findings.good()
    if not (condition.where & ~printed).any():
        return condition is findings.conditions[0] or not good[printed].all()
    if " and " not in condition.words:
        return True
    period = condition.words.partition(" and ")[0]
    alike = [c for c in findings.conditions if c.words.partition(" and ")[0] == period]
    kept = [c for c in alike if c.where.any() and good[c.where].all()]
    return bool(kept) and condition is max(kept, key=lambda c: int(c.where.sum()))


def scenarios_table(findings: Findings) -> tuple[str, Table]:
    """Every scenario that the paper speaks of, or, of many, those that are not as claimed."""
    printed, good = findings.conditions[0].where, findings.good()
    title, chosen = "Every scenario", np.flatnonzero(printed)
    if len(chosen) > MOST_ROWS:
        chosen = np.flatnonzero(printed & ~good)
        title = f"Scenarios that are not as claimed, {len(chosen)} of {int(printed.sum())}"
        if len(chosen) > MOST_ROWS:
            title, chosen = f"{title}: the first {MOST_ROWS}", chosen[:MOST_ROWS]
    header = ("scenario", *(_titled(e.quantity, e.bound) for e in findings.evidence), "as claimed")
    rows = [
        (
            findings.scenarios[int(i)],
            *(number(e.values[i]) for e in findings.evidence),
            "yes" if good[i] else "no",
        )
        for i in chosen
    ]
    return title, Table(header, rows)


def _titled(quantity: str, bound: str) -> str:
    return f"{quantity} ({bound})"


def anchor(title: str) -> str:
    """What a part of the page is linked by."""
    return "-".join(re.findall(r"[a-z0-9]+", title.lower()))


def typeset(text: str) -> str:
    """A text with the signs of print."""
    for plain, sign in SIGNS.items():
        text = text.replace(plain, sign)
    return text


def number(value: float) -> str:
    """Three digits, as 0.00152 or 1.5e-6."""
    if np.isinf(value):
        return "never" if value > 0 else "-inf"
    text = f"{value:.3g}"
    mantissa, exponent, power = text.partition("e")
    return f"{mantissa}e{int(power)}" if exponent else text


def _range(values: np.ndarray) -> str:
    low, high = number(np.min(values)), number(np.max(values))
    return low if low == high else f"{low} to {high}"
