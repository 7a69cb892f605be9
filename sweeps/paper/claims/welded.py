"""C1 to C4: the joint welded to a spring and a damper (fig:4 left, fig:6)."""

import numpy as np
import pandas as pd

from fic_jax import Params
from sweeps.paper.scenarios import Reading, run, scenarios, study


def welded(reading: Reading) -> pd.DataFrame:
    """K0 by Td, at each period of the reading."""
    return study("welded", reading)


def worst_case(reading: Reading) -> pd.DataFrame:
    """`welded` beside the case named, K0 = 1 and Td = 1, at the same period.

    Columns: its nmse (`named`), and with a tenth of sigma its nmse and tail (`finer`,
    `finer_tail`), with five times sigma its nmse (`wider`).
    """
    table = welded(reading)
    case = scenarios("paper-welded").query("K0 == 1 and Td == 1")
    sigma = Params().sigma
    cases = run(pd.concat([case.assign(sigma=factor * sigma) for factor in (0.1, 5.0)]), reading)
    finer = cases[cases.sigma < sigma].set_index("period")
    wider = cases[cases.sigma > sigma].set_index("period")
    named = table.query("K0 == 1 and Td == 1").set_index("period")
    at = table["period"]
    return table.assign(
        named=at.map(named.nmse),
        finer=at.map(finer.nmse),
        finer_tail=at.map(finer.nmse_tail),
        wider=at.map(wider.nmse),
    )


def unreachable(reading: Reading) -> pd.DataFrame:
    """The cases of `welded` whose Td is beyond Fmax, with the mean error in N*m."""
    table = welded(reading).query("Td > Fmax")
    return table.assign(mean_error=table.steady_error * np.minimum(table.Td, table.Fmax))
