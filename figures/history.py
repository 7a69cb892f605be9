"""Time histories of named cells of a store: torque and position, run anew."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from fic_jax import Params, histories
from figures import caption, signal, style
from figures.cut import Cells, PlotError, Wanted, cells, cut
from sweeps.plan.grid import Grid

MOST_LINES = 6  # colours and dashes that a reader can tell apart
MOST_SAMPLES = 200_000  # of a line
WIDTH = 205  # point, of the axes
# A motion that has left this multiple of the largest torque is drawn no further.
DIVERGED = 1e3
REFERENCE = "0.45"


@dataclass(frozen=True)
class History:
    """One cell of a store, and its motion."""

    cell: Cells
    run: xr.Dataset


def select(data: xr.Dataset, at: Sequence[Wanted]) -> list[tuple[Cells, tuple[int, ...]]]:
    """The cell of a store at each of some values, and its index along each dimension.

    A value that was not run is replaced by the nearest one (`cut`). Raises PlotError for a request
    that the store can't answer, or for more cells than a picture can tell apart.
    """
    metric = next(str(name) for name in data.data_vars)
    found = {}
    for wanted in at:
        part = cut(data, (), metric, wanted)
        found[part.attrs["index"]] = cells(part, metric)
    if len(found) > MOST_LINES:
        raise PlotError(f"{len(found)} cells are too many for a picture: name up to {MOST_LINES}.")
    return [(cell, index) for index, cell in found.items()]


def simulate(grid: Grid, index: tuple[int, ...], dtype: str) -> xr.Dataset:
    """The motion of a cell, with the model, the step and the parameters of its sweep."""
    block = tuple(slice(i, i + 1) for i in index)
    params = Params(**{n: v.reshape(()) for n, v in vars(grid.params(block, dtype)).items()})
    steps = grid.sweep.n_steps
    every = next(k for k in range(1, steps + 1) if steps % k == 0 and steps // k <= MOST_SAMPLES)
    model, dt = grid.model(block), grid.sweep.time.dt
    return histories(params, model=model, dt=dt, n_steps=steps, every=every).isel(scenario=0)


def plot(drawn: Sequence[History]) -> Figure:
    """Torque over position, a line for each cell; thin lines mark Td and the environment."""
    with style.look():
        width = 72 * style.COLUMN_WIDTH - 10
        parts = [history.cell for history in drawn]
        common = caption.shared([part.fixed for part in parts])
        lines = [style.fold(parts[0].name, width), *([style.wrap(common, width)] if common else [])]
        head, held = "\n".join(line for line in lines if line), caption.held(parts, width)
        labels = [_label(history.cell, common) for history in drawn]
        fig = Figure()
        torque, position = fig.subplots(2, 1, sharex=True)
        shades = style.ordered(len(drawn))
        bands = [
            _lines(torque, position, history, {"color": colour, "ls": dashes, "lw": 0.9})
            for history, colour, dashes in zip(drawn, shades, style.DASHES, strict=False)
        ]
        end = max(float(history.run["time"][-1]) for history in drawn)
        torque.set(ylabel="torque $T$ (N·m)")
        position.set(ylabel="position $x$ (rad)", xlabel="$t$ (s)", xlim=(0.0, end))
        fig.align_ylabels()
        fig.suptitle(head)
        handles = [
            Line2D([], [], color=colour, ls=dashes, lw=0.9)
            for _, colour, dashes in zip(drawn, shades, style.DASHES, strict=False)
        ]
        handles.append(Line2D([], [], color=REFERENCE, lw=0.5))
        labels.append("$T_d$, environment")
        if any(bands):
            handles.append(Line2D([], [], color=REFERENCE, alpha=signal.BAND, lw=6))
            labels.append(signal.LABEL)
        box = fig.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=1 if max(map(len, labels)) > 30 else 2,
            frameon=False,
            title=held or None,
        )
        box.get_title().set_multialignment("center")
        rows = len(handles) + 0.75 * (held.count("\n") + 1)
        fig.set_size_inches(style.COLUMN_WIDTH, 3.2 + 0.13 * head.count("\n") + 0.15 * rows)
    return fig


def _lines(torque: Axes, position: Axes, history: History, look: dict[str, Any]) -> bool:
    """Draw one motion; returns whether a part of it is a band."""
    run = history.run
    t, T, x = (run[name].values.astype(float) for name in ("time", "tau_env", "x"))
    kept = _before_divergence(T, max(abs(float(run["Td"])), float(run["Fmax"])))
    bands = [
        signal.draw(ax, t[:kept], y[:kept], WIDTH, **look) for ax, y in ((torque, T), (position, x))
    ]
    if kept < t.size:
        for ax, y in ((torque, T), (position, x)):
            ax.plot(t[kept - 1], y[kept - 1], "x", color=look["color"], ms=5, mew=1.2)
    for ax, name in ((torque, "Td"), (position, "gap")):
        ax.axhline(float(run[name]), color=REFERENCE, lw=0.5, zorder=0)
    return any(bands)


def _before_divergence(T: NDArray[np.float64], largest: float) -> int:
    """Number of samples before the motion leaves what a picture can show; at least one."""
    beyond = np.flatnonzero(~(np.abs(T) <= DIVERGED * largest))
    return max(int(beyond[0]), 1) if beyond.size else T.size


def _label(cell: Cells, common: Sequence[str]) -> str:
    own = [text for text in cell.fixed if text not in common]
    text = ", ".join(own) or "this cell"
    if "diverged" in cell.special:
        return f"{text} (diverged: to the cross)"
    doubtful = cell.untrusted is not None and bool(cell.untrusted)
    return f"{text} ({cell.metric} not trusted)" if doubtful else text
