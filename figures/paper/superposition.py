"""Torque of both branches at the switch (fig:1b): Algorithm 1 beside the older law."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fic_jax import Model, Params
from fic_jax.controller import begin_branch, torque
from fic_jax.params import Law, canonical
from figures import style
from figures.paper import look

PEAKS = (0.06, 0.11, 0.2)  # rad: before x0, at xb, where the older law asks for more than Fmax
NODES = 2001  # samples of a branch; a jump at x0 is drawn within one of them
LEAST_JUMP = 0.05  # N*m; less prints as nothing
NOTE: dict[str, Any] = {"textcoords": "offset points", "fontsize": style.SMALL_SIZE}
LEADER = {"arrowstyle": "-", "lw": 0.5}
TITLES: dict[Law, str] = {"algorithm1": "Algorithm 1", "energy": "older law"}
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Branch:
    """Torque (N*m) over the error (rad), up to a peak."""

    e: Array
    torque: Array
    unlimited: Array  # before the controller limits it to Fmax


@dataclass(frozen=True)
class Switches:
    """The branches that meet at some peak errors, under one law."""

    law: Law
    params: Params
    divergence: Branch  # up to the largest peak
    convergence: tuple[Branch, ...]  # from each peak; the last sample is the switch


def compute(law: Law, params: Params = look.PAPER, peaks: tuple[float, ...] = PEAKS) -> Switches:
    """Both branches at each peak, in float64."""
    with jax.enable_x64(True):
        p, model = canonical(params), Model(law=law)

        def branch(peak: float, diverging: bool) -> Branch:
            e = jnp.linspace(0.0, peak, NODES)
            attractor = begin_branch(peak, jnp.array(diverging), jnp.asarray(peak), p, model)
            limited = jax.vmap(lambda e: torque(e, attractor, p))(e)
            if diverging:
                return Branch(np.asarray(e), np.asarray(limited), np.asarray(limited))
            free = replace(p, Fmax=jnp.inf)
            unlimited = jax.vmap(lambda e: torque(e, attractor, free))
            return Branch(np.asarray(e), np.asarray(limited), np.asarray(unlimited(e)))

        convergence = tuple(branch(peak, False) for peak in peaks)
        return Switches(law, params, branch(max(peaks), True), convergence)


def jumps(data: Switches) -> Array:
    """Torque of convergence less that of divergence at each switch, N*m, before the limit."""
    at = [np.interp(b.e[-1], data.divergence.e, data.divergence.torque) for b in data.convergence]
    return np.array([b.unlimited[-1] for b in data.convergence]) - at


def broken(branch: Branch) -> tuple[float, float]:
    """Where a branch jumps by most (rad), and by how much (N*m) with growing error."""
    steps = np.diff(branch.unlimited)
    excess = steps - np.median(steps)
    at = int(np.argmax(np.abs(excess)))
    return float(branch.e[at]), float(excess[at])


def plot(data: tuple[Switches, ...]) -> Figure:
    """Torque over the error, a panel for each law; the jump at each switch is a number."""
    with style.look():
        fig = Figure(figsize=(style.PAGE_WIDTH, 2.6))
        panels = fig.subplots(1, len(data), sharex=True, sharey=True, squeeze=False)[0]
        for ax, law in zip(panels, data, strict=True):
            _draw(ax, law)
            ax.set(title=TITLES[law.law], xlabel=r"$\tilde{x}$ (rad)")
        panels[0].set_ylabel(r"controller torque $h_e$ (N·m)")
        top = max(b.unlimited.max() for law in data for b in law.convergence)
        panels[0].set_ylim(-1.12 * top, 1.18 * top)
        panels[0].set_xlim(0.0, 1.15 * max(law.divergence.e[-1] for law in data))
        handles = panels[0].get_legend_handles_labels()
        fig.legend(*handles, loc="outside upper center", ncols=4, frameon=False)
    return fig


def _draw(ax: Axes, law: Switches) -> None:
    up, Fmax = law.divergence, float(law.params.Fmax)
    for side in (-1, 1):
        ax.axhline(side * Fmax, color="0.8", lw=0.5, zorder=0)
    place: dict[str, Any] = {"fontsize": style.SMALL_SIZE, "color": look.REFERENCE, "va": "bottom"}
    ax.text(0.002, Fmax, style.SYMBOLS["Fmax"], **place)
    ax.axhline(0.0, color="0.8", lw=0.5, zorder=0)
    ax.plot(up.e, up.torque, color=look.DIVERGENCE, lw=1.4, label="divergence")
    colour = look.CONVERGENCE
    for i, (down, jump) in enumerate(zip(law.convergence, jumps(law), strict=True)):
        before, limited = ("before the limit", "convergence") if i == 0 else (None, None)
        ax.plot(down.e, down.torque, color=colour, lw=1.0, ls=(0, (3, 1)), label=limited)
        beyond = np.where(np.abs(down.unlimited) > Fmax, down.unlimited, np.nan)
        ax.plot(down.e, beyond, color=colour, lw=1.0, ls=(0, (1, 1)), label=before)
        e, after = down.e[-1], down.unlimited[-1]
        ax.plot([e, e], [after - jump, after], color="0.15", lw=0.8, marker="o", ms=2.5)
        text = "no jump" if abs(jump) < LEAST_JUMP else f"jump {_signed(jump)}"
        ax.annotate(text, (e, max(after, after - jump)), (0, 6), ha="center", **NOTE)
        at, step = broken(down)
        if abs(step) > LEAST_JUMP:
            middle = float(np.interp(at, down.e, down.unlimited))
            text = f"{_signed(step)} at {style.SYMBOLS['x0']}"
            ax.annotate(text, (at, middle), (-14, 7), ha="right", arrowprops=LEADER, **NOTE)


def _signed(jump: float) -> str:
    return f"{jump:+.1f} N·m".replace("-", "−")


def figures() -> Iterator[tuple[str, Figure]]:
    """The branches under both laws."""
    yield "superposition", plot(tuple(compute(law) for law in TITLES))
