"""The paper's fifteen claims, and how each is judged."""

from sweeps.report import contact, impact, welded
from sweeps.report.judge import judge
from sweeps.report.record import PRINTED, Claim, Judgement, Reading

CLAIMS: tuple[Claim, ...] = (
    *welded.CLAIMS,
    *contact.CLAIMS[:1],
    *impact.CLAIMS,
    *contact.CLAIMS[1:],
)

__all__ = ["CLAIMS", "PRINTED", "Claim", "Judgement", "Reading", "judge"]
