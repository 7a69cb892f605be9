"""C5, C10: the joint pressed on a hard stop, and the same with Fmax = Td (fig:4 right, fig:7)."""

import numpy as np
import pandas as pd

from fic_jax import QUANTITIES
from sweeps.paper.claims.welded import welded
from sweeps.paper.scenarios import STUDIES, Reading, run, scenarios, study


def pressed(reading: Reading) -> pd.DataFrame:
    """K0 by Td from contact; `welded_tail` is the same scenario's nmse_tail where it is welded."""
    return study("contact", reading).assign(welded_tail=welded(reading).nmse_tail)


def limited(reading: Reading) -> pd.DataFrame:
    """The cases of C5 and C6 with Fmax = Td.

    `residual` is the root mean square of the error over the tail: a limit cycle about Td has one,
    though its mean error is none. `time_15` is the convergence time with Fmax = 15.
    """
    rows = scenarios(*STUDIES["contact"], *STUDIES["impact"])
    table = run(rows.assign(Fmax=rows.Td), reading)
    fields = [name for name in QUANTITIES if name != "Fmax"]
    names = {f"convergence_time{of}": f"time_15{of}" for of in ("", "_trusted")}
    unlimited = pd.concat([study(name, reading) for name in ("contact", "impact")])
    times = unlimited[[*fields, *names]].rename(columns=names)
    return table.merge(times, on=fields, how="left").assign(
        residual=np.sqrt(table.nmse_tail), residual_trusted=table.nmse_tail_trusted
    )
