"""What a report is made of: claims with evidence and computed verdicts, sections beyond them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fic_jax import Metrics, Model, Sample

Verdict = Literal["holds", "holds where", "does not hold"]


@dataclass(frozen=True, eq=False)
class Runner:
    """Where metrics and time histories of scenarios come from, other than a sweep of their own."""

    metrics: Callable[[dict[str, np.ndarray], Model, float], Metrics]  # fields, model, dt
    histories: Callable[[dict[str, np.ndarray], Model, float], Sample]  # leaves [N, steps]


@dataclass(frozen=True)
class Reading:
    """One reading of the paper: its static choices, and how time is cut up."""

    model: Model = Model()
    period: float = 0.01  # s, control period
    dt: float = 0.01  # s, plant step
    # s, other periods that a condition may name; tried where the claim fails at `period`
    others: tuple[float, ...] = ()
    runner: Runner | None = None  # None: each study runs its own sweep


PRINTED = Reading()


@dataclass(frozen=True)
class Evidence:
    """One quantity over a set of scenarios, and whether each of them is as the paper says."""

    quantity: str  # what was measured, with its unit
    values: np.ndarray  # [N]
    good: np.ndarray  # [N] bool: as claimed
    bound: str  # the claim in numbers, as "<= 1e-4"


@dataclass(frozen=True)
class Condition:
    """A part of the scenarios, in words: where a claim is asked whether it holds."""

    words: str  # "K0 <= 100 and Td <= Fmax"; empty: everywhere
    where: np.ndarray  # [N] bool


@dataclass(frozen=True)
class Findings:
    """What was measured for a claim. All its evidence is of the same scenarios."""

    scenarios: Sequence[str]  # [N] names of the scenarios
    evidence: Sequence[Evidence]
    conditions: Sequence[Condition]  # widest first; the first is what the paper claims, words ""
    key: str  # the number that decides, in words
    numbers: Mapping[str, float | str] = field(default_factory=dict)  # for the reason and tests

    def good(self) -> np.ndarray:
        """[N] bool: scenarios that are as claimed in all the evidence."""
        return np.logical_and.reduce([e.good for e in self.evidence])


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and how it is measured."""

    id: str  # "C1"
    title: str  # a few words
    statement: str  # the paper's words
    source: str  # where they stand
    scenario: str  # what is run
    command: str  # what makes the numbers
    figure: str  # stem of the picture that shows it; empty: none
    measure: Callable[[Reading], Findings]
    reasons: Mapping[Verdict, str]  # why, for each verdict; {name} stands for a number


@dataclass(frozen=True)
class Judgement:
    """A claim's verdict under one reading."""

    claim: Claim
    reading: Reading
    findings: Findings
    verdict: Verdict
    condition: str  # of "holds where", else empty
    score: float  # share of the scenarios the paper speaks of that are as claimed

    @property
    def key(self) -> str:
        """The number that decides, in words."""
        return self.findings.key

    @property
    def words(self) -> str:
        """The verdict as a text: "holds where Td <= Fmax"."""
        return f"{self.verdict} {self.condition}".strip()

    @property
    def reason(self) -> str:
        """Why the verdict is what it is, with the measured numbers."""
        return self.claim.reasons[self.verdict].format_map(self.findings.numbers)


@dataclass(frozen=True)
class Section:
    """A finding beyond the paper's claims; every number in its text is computed."""

    title: str
    text: str  # Markdown paragraphs
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    figure: str  # stem of its picture
    command: str  # what makes it
