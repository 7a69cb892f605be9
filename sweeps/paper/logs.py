"""What a simulation logs at its steps, and metrics of it.

`fic_jax` streams metrics of the motion. Here are runs that it does not offer, and the mean that a
script takes of logged samples, `mean(err.^2)`, whose weights are the solver's steps.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fic_jax.metrics import SETTLING_BAND

Floats = NDArray[np.float64]
Mean = Literal["time", "samples"]
T_END = 10.0  # s, of every simulation of the paper
MEANS = ("nmse", "nmse_tail", "steady_error")
LASTING = 0.05  # of the run: how long before its end a torque that has converged stays in its band


@dataclass(frozen=True)
class Log:
    """N runs: a row for each, NaN after its last sample."""

    t: Floats  # [N, k], s; the first sample is the start
    x: Floats  # rad
    v: Floats  # rad/s
    tau_env: Floats  # N*m
    diverging: Floats  # 1 or 0, of the step that ends here

    def runs(self) -> "list[Log]":
        """Each run alone, its leaves [k]."""
        lengths = np.count_nonzero(~np.isnan(self.t), axis=1)
        leaves = vars(self).values()
        return [Log(*(leaf[i, :k] for leaf in leaves)) for i, k in enumerate(lengths)]


def measured(log: Log, rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with metrics of their runs: names and definitions of `fic_jax.Metrics`.

    T is linear in time between samples. MEANS come once more, `<metric>_of_samples`, as means over
    the samples after the start, whatever time lies between them.
    """
    columns = (rows[name].to_numpy() for name in ("Td", "Fmax", "gap", "contact"))
    metrics = [
        _metrics(run, Td, min(Td, Fmax), gap, contact == "welded")
        for run, Td, Fmax, gap, contact in zip(log.runs(), *columns, strict=True)
    ]
    return rows.assign(**pd.DataFrame(metrics, index=rows.index))


def _metrics(run: Log, Td: float, T_n: float, gap: float, welded: bool) -> dict[str, float]:
    eps = (run.tau_env - Td) / T_n
    averaged = {"nmse": (eps**2, 0.0), "nmse_tail": (eps**2, T_END / 2)}
    averaged |= {"steady_error": (eps, T_END / 2)}
    touching = np.full(run.t.shape, True) if welded else run.x >= gap
    touched = bool(touching.any())
    first = int(np.argmax(touching))
    lost = ~touching[first:]
    return {
        **{name: average(run.t, *of, "time") for name, of in averaged.items()},
        **{f"{name}_of_samples": average(run.t, *of, "samples") for name, of in averaged.items()},
        "convergence_time": _settled(run.t, run.tau_env / T_n - 1.0),
        "peak_torque": float(np.abs(run.tau_env).max()),
        "overshoot": max(float((run.tau_env / T_n).max()) - 1.0, 0.0),
        "contact_time": float(run.t[first]) if touched else np.inf,
        "contact_lost": float(np.diff(run.t)[first:][lost[1:]].sum()) if touched else 0.0,
        "mode_switches": float(np.count_nonzero(np.diff(run.diverging[1:]))),
    }


def average(t: Floats, signal: Floats, since: float, mean: Mean, until: float = T_END) -> float:
    """The mean of a signal from `since` to `until`, over time or over samples."""
    if mean == "samples":
        return float(signal[(t > since) & (t <= until)].mean())
    inside = (t > since) & (t < until)
    times = np.concatenate([[since], t[inside], [until]])
    return float(np.trapezoid(np.interp(times, t, signal), times) / (until - since))


def _settled(t: Floats, off: Floats) -> float:
    """When the torque has entered its band for good; inf if that is too near the end to tell."""
    outside = np.flatnonzero(np.abs(off) > SETTLING_BAND)
    if not outside.size:
        return 0.0
    last = int(outside[-1])
    if last == len(t) - 1:
        return np.inf
    edge = np.copysign(SETTLING_BAND, off[last])
    part = (off[last] - edge) / (off[last] - off[last + 1])
    time = float(t[last] + part * (t[last + 1] - t[last]))
    return time if time <= (1.0 - LASTING) * t[-1] else np.inf
