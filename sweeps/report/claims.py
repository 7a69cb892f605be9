"""The paper's fifteen claims, and how each is judged."""

from sweeps.report import welded
from sweeps.report.judge import judge
from sweeps.report.record import PRINTED, Claim, Judgement, Reading

CLAIMS: tuple[Claim, ...] = welded.CLAIMS

__all__ = ["CLAIMS", "PRINTED", "Claim", "Judgement", "Reading", "judge"]
