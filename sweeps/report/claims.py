"""The paper's fifteen claims, and how each is judged."""

from sweeps.report import attractor, contact, impact, stability, welded
from sweeps.report.judge import judge
from sweeps.report.record import PRINTED, Claim, Judgement, Reading

CLAIMS: tuple[Claim, ...] = (
    *welded.CLAIMS,
    *contact.CLAIMS[:1],
    *impact.CLAIMS,
    *contact.CLAIMS[1:],
    *attractor.CLAIMS,
    *stability.CLAIMS,
)

__all__ = ["CLAIMS", "PRINTED", "Claim", "Judgement", "Reading", "judge"]
