"""Phase portrait of the fractal attractor (fig:0a): an inertia that nothing else acts on."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fic_jax import Model, Params, init, rollout
from figures import style
from figures.paper import look

ENERGIES = (0.125, 0.7, 1.25, 2.0, 2.75, 3.4, 4.5)  # J, kinetic, on passing the reference
LARGEST_PEAK = 0.3  # rad; paths beyond are omitted, as in the paper
NEAR = {"xlim": (-0.004, 0.034), "ylim": (-0.17, 0.02)}  # rad, rad/s: the last steps home
HEAD = 0.4  # of a branch's length, where its arrow is
MODEL = Model(contact="welded", integrator="rk4_events")  # a weld to nothing: Kenv = Denv = 0


def simulate(
    energies: tuple[float, ...] = ENERGIES, dt: float = 0.002, t_end: float = 4.0
) -> xr.Dataset:
    """Paths that leave the reference with either sign and each energy, in float64.

    sigma = 0 keeps the reference of Algorithm 2 at Td/K0.
    """
    signed = np.array([s * E for E in energies for s in (1.0, -1.0)])
    inertia = look.PAPER.I

    def one(v: jax.Array) -> tuple[jax.Array, ...]:
        p = Params(Kenv=0.0, Denv=0.0, sigma=0.0, period=dt, v_init=v)
        at_reference = replace(p, x_init=init(p, MODEL).memory.x_h)
        path = rollout(at_reference, model=MODEL, dt=dt, n_steps=round(t_end / dt))
        return path.e, -path.v, path.diverging

    with jax.enable_x64(True):
        start = np.sign(signed) * np.sqrt(2.0 * np.abs(signed) / inertia)
        e, rate, diverging = (np.asarray(a) for a in jax.jit(jax.vmap(one))(start))
    dims = ("path", "t")
    runs = {"e": (dims, e), "rate": (dims, rate), "diverging": (dims, diverging)}
    return xr.Dataset(runs, {"energy": ("path", np.abs(signed))})


def plot(data: xr.Dataset) -> Figure:
    """The rate of the error over the error x~, with the reference's surroundings enlarged."""
    shown = data.isel(path=np.flatnonzero(abs(data["e"]).max("t") <= LARGEST_PEAK))
    with style.look():
        fig = Figure(figsize=(style.COLUMN_WIDTH, 3.0))
        ax = fig.subplots()
        near = _inset(ax)
        for i in range(shown.sizes["path"]):
            for panel in (ax, near):
                _draw(panel, shown.isel(path=i), first=i == 0, heads=panel is ax)
        for panel in (ax, near):
            panel.plot(0, 0, "o", color="black", ms=2.5, zorder=4)
        ax.set(xlim=(-0.33, 0.33), ylim=(-1.05, 1.05))
        ax.set(xlabel=r"$\tilde{x}$ (rad)", ylabel=r"$\dot{\tilde{x}}$ (rad/s)")
        look.mark_bounds(ax, look.PAPER, sides=(-1, 1))
        place: dict[str, Any] = {"loc": "outside upper center", "ncols": 2, "frameon": False}
        fig.legend(*ax.get_legend_handles_labels(), **place)
    return fig


def _inset(ax: Axes) -> Axes:
    """An enlargement of the last steps home, in the corner that no path enters."""
    near = ax.inset_axes((0.66, 0.02, 0.34, 0.22))
    near.set(**NEAR, yticks=[0, -0.1])
    near.set_xticks([0, 0.02], ["0", "0.02"])
    near.tick_params(labelsize=style.SMALL_SIZE, pad=1, labeltop=True, labelbottom=False)
    near.tick_params(top=True, bottom=False, right=True, left=False)
    near.tick_params(axis="y", labelright=True, labelleft=False)
    near.spines[:].set_visible(True)
    ax.indicate_inset_zoom(near, edgecolor="0.5", lw=0.5)
    return near


def _draw(ax: Axes, path: xr.Dataset, first: bool, heads: bool) -> None:
    e, rate, diverging = (path[name].values for name in ("e", "rate", "diverging"))
    branches = {
        "divergence": (diverging, look.DIVERGENCE, "-"),
        "convergence": (~diverging, look.CONVERGENCE, (0, (3, 1))),
    }
    for name, (inside, colour, dashes) in branches.items():
        joined = inside | np.append(inside[1:], False)  # from the sample before, so none gapes
        x, y = np.where(joined, e, np.nan), np.where(joined, rate, np.nan)
        ax.plot(x, y, color=colour, ls=dashes, lw=0.9, label=name if first else None)
        if heads:
            _arrow(ax, e, rate, inside, colour)


def _arrow(ax: Axes, e: np.ndarray, rate: np.ndarray, inside: np.ndarray, colour: str) -> None:
    """A head on a branch, at a share of the length drawn."""
    length = np.cumsum(np.where(inside[1:], np.hypot(np.diff(e), np.diff(rate)), 0.0))
    if length[-1] == 0.0:
        return
    at = int(np.searchsorted(length, HEAD * length[-1]))
    tip = {"arrowstyle": "-|>", "color": colour, "lw": 0, "mutation_scale": 7}
    ax.annotate("", (e[at + 1], rate[at + 1]), (e[at], rate[at]), arrowprops=tip)


def figures() -> Iterator[tuple[str, Figure]]:
    """The portrait of simulated paths."""
    yield "attractor", plot(simulate())
