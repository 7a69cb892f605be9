"""The paper's fifteen claims.

C7.md is the file of claim C7: its words; the query `good`, true for a scenario that is as claimed;
the queries `conditions`, parts of the scenarios in which the claim may hold. The queries select
rows of a table with one row for each scenario, which these files make:

| claims | file | what is simulated |
|---|---|---|
| C1 to C4 | welded.py | the joint welded to its environment |
| C5, C10 | contact.py | the joint pressed on a hard stop, and with Fmax = Td |
| C6 to C9 | impact.py | the approach from 0.5 rad |
| C11 to C13 | attractor.py | the force profile and the attractor alone |
| C14 | superposed.py | several controllers on one inertia |
| C15 | retuned.py | a stiffness that changes |
"""

from collections.abc import Callable, Sequence

import pandas as pd

from sweeps.paper.claims import attractor, contact, impact, retuned, superposed, welded
from sweeps.paper.judge import Claim
from sweeps.paper.scenarios import Reading
from sweeps.paper.words import read
from sweeps.spec.mistakes import SweepError

TABLES: dict[str, Callable[[Reading], pd.DataFrame]] = {
    "C1": welded.welded,
    "C2": welded.welded,
    "C3": welded.worst_case,
    "C4": welded.unreachable,
    "C5": contact.pressed,
    "C6": impact.approach,
    "C7": impact.observed,
    "C8": impact.damped_beside_bare,
    "C9": impact.largest,
    "C10": contact.limited,
    "C11": attractor.profile,
    "C12": attractor.cycles,
    "C13": attractor.portraits,
    "C14": superposed.draws,
    "C15": retuned.schedules,
}


def claim(id: str) -> Claim:
    """A claim, its queries read from its file."""
    head = read(f"claims/{id}").head
    return Claim(id, TABLES[id], *(head[name] for name in ("by", "measured", "good", "conditions")))


CLAIMS = tuple(claim(id) for id in TABLES)


def chosen(ids: Sequence[str]) -> list[Claim]:
    """The claims of these names, all if there are none. Raises SweepError for an unknown one."""
    known = {claim.id: claim for claim in CLAIMS}
    for name in ids:
        if name.upper() not in known:
            raise SweepError(f"--only {name}: is no claim; there are {', '.join(known)}")
    return [known[name.upper()] for name in dict.fromkeys(ids or known)]
