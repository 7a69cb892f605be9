"""The swing of a joint whose stiffness changes in step with its motion, beside the derived one."""

import numpy as np
import pandas as pd
import xarray as xr

from fic_jax import Model, Params
from sweeps.paper.claims.retuned import LAST, RELEASE, SECONDS, in_step, round_time
from sweeps.paper.superposition import DT, SLICE, bodies, gains, simulate

STORES = ()
RATIOS = (2.0, 2.9, 3.2, 4.0, 10.0)


def measure() -> xr.Dataset:
    """The swing over time, and what a round multiplies it by, derived and measured."""
    K0 = np.array([in_step(100.0, 100.0 / ratio) for ratio in RATIOS])[..., None]
    n = len(RATIOS)
    released = bodies(n, x_init=np.full(n, RELEASE))
    swing = simulate(gains(K0=K0), released, Model(), SECONDS).swing
    rounds = np.array([round_time(100.0, 100.0 / ratio) for ratio in RATIOS])
    predicted = np.sqrt((np.array(RATIOS) - 1.0) / 2.0)
    factor = [_factor(*run) for run in zip(swing, rounds, predicted, strict=True)]
    over = {"swing": (("ratio", "t"), swing), "round": ("ratio", rounds)}
    over |= {"factor": ("ratio", factor), "predicted": ("ratio", predicted)}
    centres = (np.arange(swing.shape[1]) + 0.5) * SLICE * DT
    return xr.Dataset(over, {"ratio": list(RATIOS), "t": centres}, {"x0": float(Params().x0)})


def _factor(swing: np.ndarray, length: float, derived: float) -> float:
    """What a round multiplies the swing by, over ten rounds or as many as are linear."""
    linear = np.log(Params().x0 / RELEASE) / np.log(derived) if derived > 1.0 else np.inf
    rounds = int(min(10, linear))
    peak = round(rounds * length / (SLICE * DT))
    return float((swing[peak - 1 : peak + 2].max() / RELEASE) ** (1.0 / rounds))


def rows(data: xr.Dataset) -> pd.DataFrame:
    """A row for each ratio; `top` and `last`, the largest swing of the run and of its last 10 s."""
    swing = data["swing"]
    ends = data.assign(top=swing.max("t"), last=swing[:, -LAST:].max("t"))
    return ends.drop_dims("t").to_dataframe().reset_index()


lines = rows
