"""What the paper's figures share: colours, line ends, labels, and where they are written."""

from collections.abc import Iterable
from pathlib import Path

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fic_jax import QUANTITIES, Params
from figures import style

# Okabe and Ito (2008): told apart by colour-blind readers, and in grey by their luminance.
DIVERGENCE, CONVERGENCE, OLDER = "#0072B2", "#D55E00", "0.15"
MORE, LESS = "#009E73", "#D55E00"  # green and red of fig:1a; a hatch tells them apart as well
REFERENCE = "0.45"  # bounds and set values

MARKERS = ("o", "s", "D", "^", "v")
DASHES = ("-", "--", "-.", (0, (1, 1)), (0, (4, 1, 1, 1, 1, 1)))

FOLDER = Path("results/figures")


def mark_bounds(ax: Axes, p: Params, sides: tuple[int, ...] = (1,)) -> None:
    """x0 and xb as thin lines, named above the axes."""
    for field, align in (("x0", "right"), ("xb", "left")):
        for side in sides:
            ax.axvline(side * float(getattr(p, field)), color="0.8", lw=0.5, zorder=0)
        at, top = float(getattr(p, field)), ax.get_xaxis_transform()
        ax.text(at, 1.0, style.SYMBOLS[field], ha=align, va="bottom", transform=top)


def ordered(n: int) -> list[tuple[float, float, float, float]]:
    """Colours of n ordered values, dark to light, none too pale to print."""
    shades = colormaps[style.SEQUENTIAL]
    return [shades(0.85 * i / max(n - 1, 1)) for i in range(n)]


def label(field: str) -> str:
    """Symbol and unit of a field of Params, for an axis."""
    return f"{style.SYMBOLS[field]} ({unit(field)})"


def unit(field: str) -> str:
    """Unit of a field of Params, for print."""
    return style.units_text(QUANTITIES[field]["unit"])


def values(field: str, numbers: Iterable[float]) -> list[str]:
    """`symbol = value unit` for each of some values of a field."""
    return [f"{style.SYMBOLS[field]} = {style.number(n)} {unit(field)}" for n in numbers]


def write(figure: Figure, folder: Path, name: str) -> str:
    """Save a figure as a PNG in a folder; returns its name."""
    folder.mkdir(parents=True, exist_ok=True)
    style.save(figure, folder / f"{name}.png")
    return name
