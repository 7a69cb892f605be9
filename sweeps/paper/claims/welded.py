"""C1 to C4: the joint welded to a spring and a damper (fig:4 left, fig:6)."""

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from fic_jax import Model, Params, init, step
from fic_jax.params import canonical
from sweeps.paper import logs, simulink
from sweeps.paper.logs import T_END
from sweeps.paper.scenarios import SAMPLE, Reading, params, rounded, run, scenarios, study

SAME = 0.01  # relative change of an nmse with the step and with rounding that is none
NUDGE = 1e-12  # rad, beyond xd = 0: Algorithm 2 searches at once, and does not set x_h to Td/K0


def welded(reading: Reading) -> pd.DataFrame:
    """K0 by Td, at each period of the reading."""
    return study("welded", reading)


def worst_case(reading: Reading) -> pd.DataFrame:
    """`welded` beside the case named, K0 = 1 and Td = 1, at the same period.

    Columns: its nmse (`named`), and with a tenth of sigma its nmse, if it is trusted, its nmse in
    any case, and tail (`finer`, `finer_found`, `finer_tail`), with five times sigma its nmse
    (`wider`), and without the first reference xd + Td/K0, when the search begins at xd, its nmse
    (`without`).
    """
    return _worst_case(reading.simplest(scenarios("paper-welded")))


@lru_cache(maxsize=128)
def _worst_case(reading: Reading) -> pd.DataFrame:
    table = welded(reading)
    case = scenarios("paper-welded").query("K0 == 1 and Td == 1")
    sigma = Params().sigma
    cases = run(pd.concat([case.assign(sigma=factor * sigma) for factor in (0.1, 5.0)]), reading)
    finer = cases[cases.sigma < sigma].set_index("period")
    wider = cases[cases.sigma > sigma].set_index("period")
    named = table.query("K0 == 1 and Td == 1").set_index("period")
    without = _without_first_reference(case, reading)
    at = table["period"]
    return table.assign(
        named=at.map(named.nmse),
        named_trusted=at.map(named.nmse_trusted),
        finer=at.map(finer.nmse.where(finer.nmse_trusted)),
        finer_found=at.map(finer.nmse),
        finer_tail=at.map(finer.nmse_tail),
        wider=at.map(wider.nmse),
        without=at.map(without["nmse"]),
        without_trusted=at.map(without["trusted"]),
    )


def _without_first_reference(case: pd.DataFrame, reading: Reading) -> pd.DataFrame:
    """nmse of a case whose search begins at xd, for each period of the reading."""
    found = {}
    for period, dt in reading.steps():
        rows = pd.concat([case, rounded(case)]).assign(period=period, x_init=NUDGE)
        fine = min(dt, SAMPLE)
        steps = (fine, fine / 2) if reading.resolved else (dt,)
        nmse = np.concatenate([_nmse_from(rows, reading, h) for h in steps])
        same = bool(np.ptp(nmse) <= SAME * nmse[0])
        found[period] = {"nmse": float(nmse[0]), "trusted": same}
    return pd.DataFrame.from_dict(found, orient="index")


def _nmse_from(rows: pd.DataFrame, reading: Reading, dt: float) -> np.ndarray:
    """nmse of rows whose first reference is xd."""
    model = replace(reading.model, contact="welded")
    with jax.enable_x64(True):
        if reading.clock != "period":
            model = replace(model, integrator="rk4")
            log = simulink.logged(params(rows), model, reading.clock, dt, reading.rtol, rows["xd"])
            name = "nmse" if reading.mean == "time" else "nmse_of_samples"
            return logs.measured(log, rows)[name].to_numpy()
        h, n = jnp.asarray(dt), jnp.asarray(round(T_END / dt), jnp.int32)
        return np.asarray(_streamed(canonical(params(rows)), model, h, n))


@partial(jax.jit, static_argnames="model")
@partial(jax.vmap, in_axes=(0, None, None, None))
def _streamed(p: Params, model: Model, dt: jax.Array, n: jax.Array) -> jax.Array:
    """nmse from a start with x_h = xd, by the trapezoidal rule; `n` is no constant of the program,
    so that every step size has the same one."""
    start = init(p, model)
    start = replace(start, memory=replace(start.memory, x_h=p.xd, e_M=p.xd - p.x_init))

    def body(_: jax.Array, carry: Any) -> Any:
        state, last, total = carry
        state, sample = step(p, state, model=model, dt=dt)
        square = ((sample.tau_env - p.Td) / jnp.minimum(p.Td, p.Fmax)) ** 2
        return state, square, total + 0.5 * (last + square)

    at_rest = (p.Td / jnp.minimum(p.Td, p.Fmax)) ** 2
    _, _, total = jax.lax.fori_loop(0, n, body, (start, at_rest, jnp.zeros_like(dt)))
    return total / n.astype(total.dtype)


def unreachable(reading: Reading) -> pd.DataFrame:
    """The cases of `welded` whose Td is beyond Fmax, with the mean error in N*m."""
    table = welded(reading).query("Td > Fmax")
    mean_error = table.steady_error * np.minimum(table.Td, table.Fmax)
    return table.assign(mean_error=mean_error, mean_error_trusted=table.steady_error_trusted)
