"""What the report finds beyond the paper's claims: a file for each finding.

| file | question |
|---|---|
| explanation.py | Which single reading explains most of the paper, and what is left? |
| readings.py | Which reading of the paper fits its claims best? |
| variable_step.py | What does the control period change, and a solver that chooses its steps? |
| saturation.py | Does Fmax = Td remove the residual error in general? |
| search_resolution.py | Which sigma suits an environment? |
| limit_cycle.py | Where does the loop never settle? |
| online_gains.py | How fast does the swing grow where gains change in step with the motion? |

Each has STORES, the sweeps of the library that it reads; `measure(*stores)`, which makes the data
that figures/findings/NAME.py draws; and two tables for NAME.md, the words: `rows(data)`, from which
its [numbers] follow, and `lines(data)`, the lines of its [table].
"""

from types import ModuleType

from sweeps.paper.findings import (
    explanation,
    limit_cycle,
    online_gains,
    readings,
    saturation,
    search_resolution,
    variable_step,
)

FINDINGS: tuple[ModuleType, ...] = (
    explanation,
    readings,
    variable_step,
    saturation,
    search_resolution,
    limit_cycle,
    online_gains,
)


def name_of(finding: ModuleType) -> str:
    """Name of a finding's template, data and figure."""
    return finding.__name__.rpartition(".")[2]
