"""What the paper's figures share: colours, line ends, labels, and the paper's values."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes

from fic_jax import QUANTITIES, Params
from figures import style
from sweeps.paper.scenarios import scenarios

# Okabe and Ito (2008): colour-blind readers can distinguish them, and so can a grey print.
DIVERGENCE, CONVERGENCE, OLDER = "#0072B2", "#D55E00", "0.15"
MORE, LESS = "#009E73", "#D55E00"  # green and red of fig:1a; a hatch also distinguishes them
REFERENCE = "0.45"  # bounds and set values

MARKERS = ("o", "s", "D", "^", "v")

PAPER = Params()
STIFFNESSES = tuple(scenarios("paper-welded")["K0"].unique())  # N*m/rad
# s, by the ending of a picture's name: every study is drawn at the step the paper prints, and at
# one where Algorithm 2, an integrator of gain sigma/(period K0), is ten times as quick.
STEPS = {"": 0.01, "_1ms": 0.001}
GAP = 0.5  # rad, where the environment of the approach begins
ESTIMATE_ERROR = 0.001  # rad, the "1 % error" of fig:4: one hundredth of x0


def mark_bounds(ax: Axes, p: Params, sides: tuple[int, ...] = (1,)) -> None:
    """x0 and xb as thin lines, named above the axes."""
    for field, align in (("x0", "right"), ("xb", "left")):
        for side in sides:
            ax.axvline(side * float(getattr(p, field)), color="0.8", lw=0.5, zorder=0)
        at, top = float(getattr(p, field)), ax.get_xaxis_transform()
        ax.text(at, 1.0, style.SYMBOLS[field], ha=align, va="bottom", transform=top)


def label(field: str) -> str:
    """Symbol and unit of a field of Params, for an axis."""
    return f"{style.SYMBOLS[field]} ({unit(field)})" if unit(field) else style.SYMBOLS[field]


def unit(field: str) -> str:
    """Unit of a field of Params, for print."""
    return style.units_text(QUANTITIES[field]["unit"])


def values(field: str, numbers: Iterable[float]) -> list[str]:
    """`symbol = value unit` for each of some values of a field."""
    return [f"{style.SYMBOLS[field]} = {style.number(n)} {unit(field)}" for n in numbers]


def decades(values: np.ndarray) -> tuple[float, float]:
    """Whole decades around all positive values, with room for the markers at their ends."""
    drawn = np.log10(values[np.isfinite(values) & (values > 0)])
    low, high = np.floor(drawn.min()), np.ceil(drawn.max())
    room = 0.05 * (high - low)
    return 10.0 ** (low - room), 10.0 ** (high + room)


def step(period: float) -> str:
    """The time step of a study, for its title."""
    return f"plant step and control period {1000 * period:g} ms"
