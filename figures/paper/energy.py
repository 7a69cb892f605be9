"""Released versus absorbed energy (fig:1a): what Algorithm 1 gives back after a peak error."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fic_jax import Model, Params, energy
from fic_jax.controller import begin_branch, torque
from fic_jax.params import canonical
from figures import style
from figures.paper import look

LARGEST_PEAK = 0.3  # rad, as in the phase portrait
NEAR = {"xlim": (0.09, 0.15), "ylim": (-0.07, 0.045)}  # rad, J: where the difference turns
NODES = 401  # of the integrals, on either side of x0
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Energies:
    """Energies (J) over the peak error e_M (rad), before the controller limits its torque."""

    params: Params
    e_M: Array
    absorbed: Array  # E_K(e_M), while diverging
    released: Array  # int_0^e_M |F_AA| de while converging, Algorithm 1
    older: Array  # the same, the older law
    limited: Array  # as `released`, the torque limited to Fmax
    older_limited: Array  # as `older`, the torque limited to Fmax


def released(e_M: float | jax.Array, p: Params, model: Model, limited: bool) -> jax.Array:
    """int_0^e_M |F_AA(e)| de, J: what the spring gives while converging from the peak e_M.

    One half of it speeds the joint up, the other, past e_M/2, brakes it. Each side of x0 has its
    own nodes, for Algorithm 1 jumps there.
    """
    attractor = begin_branch(e_M, jnp.zeros((), bool), e_M, p, model)
    limits = p if limited else replace(p, Fmax=jnp.inf)
    middle = jnp.minimum(e_M, p.x0)
    of = jax.vmap(lambda e: torque(e, attractor, limits))
    inner = jnp.linspace(0.0, middle, NODES)
    outer = jnp.linspace(jnp.nextafter(middle, jnp.inf), e_M, NODES)
    below, above = jnp.abs(of(inner)), jnp.abs(of(outer))
    return jnp.trapezoid(below, inner) + jnp.trapezoid(above, outer)


def compute(params: Params = look.PAPER, n: int = 601) -> Energies:
    """The energies of n peak errors up to 0.3 rad, in float64."""
    with jax.enable_x64(True):
        p = canonical(params)
        e_M = jnp.linspace(0.0, LARGEST_PEAK, n + 1)[1:]

        def over(law: Model, limited: bool) -> Array:
            return np.asarray(jax.vmap(lambda e: released(e, p, law, limited))(e_M))

        algorithm1, older = Model(law="algorithm1"), Model(law="energy")
        return Energies(
            params=params,
            e_M=np.asarray(e_M),
            absorbed=np.asarray(jax.vmap(lambda e: energy(e, p))(e_M)),
            released=over(algorithm1, False),
            older=over(older, False),
            limited=over(algorithm1, True),
            older_limited=over(older, True),
        )


def sign_change(data: Energies) -> float:
    """Peak error (rad) beyond which Algorithm 1 releases less than was absorbed; NaN if none."""
    gain = data.released - data.absorbed
    last = np.flatnonzero(gain > 0)[-1:]
    if not last.size or last[0] + 1 == gain.size:
        return float("nan")
    pair = slice(last[0], last[0] + 2)
    return float(np.interp(0.0, -gain[pair], data.e_M[pair]))


def plot(data: Energies) -> Figure:
    """Both energies over the peak error, and below them their difference, shaded by its sign."""
    with style.look():
        fig = Figure(figsize=(style.COLUMN_WIDTH, 3.9))
        above, below = fig.subplots(2, 1)
        _lines(above, data, np.zeros_like(data.e_M))
        _lines(below, data, data.absorbed)
        above.set(xlim=(0, data.e_M[-1]), ylim=(0, None), ylabel="energy (J)")
        below.set(**NEAR, ylabel="released − absorbed (J)")
        for ax in (above, below):
            ax.set_xlabel(r"peak error $|\tilde{x}_{Max}|$ (rad)")
            look.mark_bounds(ax, data.params)
        turn = sign_change(data)
        below.plot(turn, 0.0, "o", color=look.OLDER, ms=2.5)
        below.text(turn, 0.006, f"{turn:.3f} rad", fontsize=style.SMALL_SIZE)
        place: dict[str, Any] = {"loc": "outside upper center", "ncols": 2, "frameon": False}
        fig.legend(*above.get_legend_handles_labels(), columnspacing=1.0, handlelength=1.5, **place)
    return fig


def _lines(ax: Axes, data: Energies, base: Array) -> None:
    """Released and absorbed energies above `base`, the difference of the two shaded."""
    absorbed, released = data.absorbed - base, data.released - base
    ax.plot(data.e_M, absorbed, color=look.OLDER, lw=1.0, label="absorbed; released, older law")
    ax.plot(data.e_M, released, color=look.DIVERGENCE, lw=1.2, label="released, Algorithm 1")
    limit = style.SYMBOLS["Fmax"]
    for curve, colour, law in (
        (data.older_limited, look.OLDER, "older law"),
        (data.limited, look.DIVERGENCE, "Algorithm 1"),
    ):
        text = f"{law}, limited to {limit}"
        ax.plot(data.e_M, curve - base, color=colour, lw=0.9, ls=(0, (1, 1.5)), label=text)
    for sign, colour, hatch, text in (
        (1, look.MORE, "", "Algorithm 1 releases more"),
        (-1, look.LESS, "////", "Algorithm 1 releases less"),
    ):
        ax.fill_between(
            data.e_M,
            absorbed,
            released,
            where=sign * (released - absorbed) > 0,
            facecolor=(colour, 0.35),
            edgecolor=(colour, 0.8),
            hatch=hatch,
            lw=0,
            label=text,
        )


def figures() -> Iterator[tuple[str, Figure]]:
    """The energies of the paper's profile."""
    yield "energy", plot(compute())
