"""The paper's fifteen claims, and how each is judged."""

from collections.abc import Sequence

from sweeps.paper import attractor, contact, impact, online_gains, stability, welded
from sweeps.paper.judge import judge
from sweeps.paper.record import PRINTED, Claim, Judgement, Reading
from sweeps.spec.mistakes import SweepError

CLAIMS: tuple[Claim, ...] = (
    *welded.CLAIMS,
    *contact.CLAIMS[:1],
    *impact.CLAIMS,
    *contact.CLAIMS[1:],
    *attractor.CLAIMS,
    *stability.CLAIMS,
    *online_gains.CLAIMS,
)

__all__ = ["CLAIMS", "PRINTED", "Claim", "Judgement", "Reading", "chosen", "judge"]


def chosen(ids: Sequence[str]) -> list[Claim]:
    """The claims of these names, all if there are none. Raises SweepError for an unknown one."""
    known = {claim.id: claim for claim in CLAIMS}
    for name in ids:
        if name.upper() not in known:
            raise SweepError(f"--only {name}: is no claim; there are {', '.join(known)}")
    return [known[name.upper()] for name in dict.fromkeys(ids or known)]
