"""The gallery: figures of the library's atlases, far beyond the paper's grid.

Each file has one figure: `SWEEPS` names the sweeps of the library that it draws, `plot(*data)` is
pure, and `finding(*data)` gives two sentences with the numbers of the data. `write` draws them all;
`page` writes the gallery. `make atlas` runs the sweeps and calls both.
"""

from collections.abc import Iterator
from pathlib import Path

from figures.atlas import (
    best,
    convergence,
    errors,
    expected,
    impact,
    lost,
    nmse,
    period,
    settled,
)
from figures.atlas.page import entry
from figures.style import save
from sweeps.store.opening import dataset

FIGURES = {
    "nmse": nmse,
    "convergence": convergence,
    "period": period,
    "expected": expected,
    "impact": impact,
    "lost": lost,
    "best": best,
    "settled": settled,
    "errors": errors,
}


def write(folder: Path, names: list[str]) -> Iterator[tuple[str, str]]:
    """Draw named figures from the stores in a folder into it; yields each name and its entry."""
    for name in names:
        figure = FIGURES[name]
        data = [dataset(folder / f"{sweep}.zarr") for sweep in figure.SWEEPS]
        drawn = figure.plot(*data)
        for suffix in (".png", ".svg"):
            save(drawn, folder / f"{name}{suffix}")
        yield name, entry(name, figure.TITLE, figure.ALT, figure.finding(*data), data)
