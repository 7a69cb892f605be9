"""From findings to a verdict: computed, never typed in."""

import numpy as np

from sweeps.paper.record import PRINTED, Claim, Condition, Findings, Judgement, Reading, Verdict


def judge(claim: Claim, reading: Reading = PRINTED) -> Judgement:
    """Measure a claim under a reading and say whether it holds.

    It holds where every scenario that the paper speaks of is as claimed. Otherwise it holds under
    the condition that covers most of them, among those whose scenarios are all as claimed, and
    under one on other scenarios (another period) where that covers still more.
    """
    findings = claim.measure(reading)
    verdict, words = verdict_of(findings)
    printed = findings.conditions[0].where
    score = float(np.mean(findings.good()[printed]))
    return Judgement(claim, reading, findings, verdict, words, score)


def verdict_of(findings: Findings) -> tuple[Verdict, str]:
    """The verdict and the condition it is under; a condition that covers nothing never counts."""
    good = findings.good()
    first, *rest = findings.conditions
    if first.where.any() and good[first.where].all():
        return "holds", ""
    kept = [c for c in rest if c.where.any() and good[c.where].all()]
    own = [c for c in kept if not (c.where & ~first.where).any()]
    other = [c for c in kept if (c.where & ~first.where).any()]
    widest = [max(part, key=_scenarios) for part in (own, other) if part]
    if len(widest) == 2 and _scenarios(widest[1]) <= _scenarios(widest[0]):
        widest.pop()
    if widest:
        return "holds where", ", or where ".join(c.words for c in widest)
    return "does not hold", ""


def _scenarios(condition: Condition) -> int:
    return int(condition.where.sum())
