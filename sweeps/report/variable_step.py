"""The control period: where the search is too slow, where it is too late, and the solver's own steps.

Algorithm 2 integrates with the gain g = sigma/(period K0). The paper gives no period for its studies
of contact, which a variable-step solver ran: a recursion without one advances once per step.
"""

import numpy as np
import xarray as xr

from fic_jax import Params, rollout
from sweeps.report import accepted, loop
from sweeps.report.record import Section
from sweeps.report.table import percent, several

CONVERGED = 1e-4  # nmse_tail that the paper reports of the welded study (C1)
KENV = (50.0, 100.0, 500.0)
CASES = {  # C5, pressed on the stop from contact, then C7, the approach from 0.5 rad
    **{f"pressed, K0 = {K0:g}": Params(K0=K0) for K0 in (0.1, 1.0, 10.0, 100.0, 1000.0)},
    **{f"approach, Kenv = {K:g}": Params(Kenv=K, gap=0.5, xd=0.5) for K in KENV},
}


def measure(periods: xr.Dataset) -> xr.Dataset:
    """The store `period-map`, what the linear loop says of it, and runs at the solver's steps."""
    mapped = periods[["nmse_tail", "mode_switches", "status"]].load()
    K0, period = np.meshgrid(mapped["K0"], mapped["period"], indexing="ij")
    turns, tail = loop.response(
        loop.starting(Params(K0=K0.ravel(), period=period.ravel())), accepted.T_END
    )
    over = ("K0", "period")
    predicted = xr.Dataset(
        {"turns": (over, turns.reshape(K0.shape)), "linear_tail": (over, tail.reshape(K0.shape))}
    )
    together = xr.merge([mapped.drop_attrs(deep=False), predicted, _runs()], join="exact")
    return together.assign_attrs(name="period-map")


def _runs() -> xr.Dataset:
    """T over time at 10 ms and at the steps of each solver, padded with NaN, and their tails."""
    names, solvers = list(CASES), list(accepted.SOLVERS)
    runs = {
        (case, solver): accepted.accepted_steps(p, kind)
        for case, p in CASES.items()
        for solver, kind in accepted.SOLVERS.items()
    }
    longest = max(len(run.t) for run in runs.values())
    shape = (len(names), len(solvers))
    t, tau = np.full((2, *shape, longest), np.nan)
    tail, lowest_tail = np.empty((2, *shape))
    for (case, solver), run in runs.items():
        at = names.index(case), solvers.index(solver)
        t[at][: len(run.t)], tau[at][: len(run.t)] = run.t, run.tau_env
        tail[at] = run.tail_nmse(5.0)
        lowest_tail[at] = np.max(run.tau_env[run.t > accepted.T_END / 2])
    fixed = [
        rollout(p, model=accepted.MODEL, dt=0.01, n_steps=1000).tau_env for p in CASES.values()
    ]
    return xr.Dataset(
        {
            "t": (("case", "solver", "step"), t),
            "tau_env": (("case", "solver", "step"), tau),
            "variable_tail": (("case", "solver"), tail),
            "highest_in_tail": (("case", "solver"), lowest_tail),
            "fixed": (("case", "sample"), np.array(fixed, float)),
        },
        coords={"case": names, "solver": solvers, "sample": 0.01 * np.arange(1, 1001)},
    )
