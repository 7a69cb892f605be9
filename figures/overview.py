"""The pictures of `make sweep`: a row of panels for each question; and the README's picture."""

import argparse
from collections.abc import Iterator
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from figures.heatmap import panels
from figures.planes import select
from figures.style import save
from sweeps.store.opening import dataset

METRICS = ("nmse", "nmse_tail", "convergence_time")


def paper(welded: xr.Dataset, contact: xr.Dataset, metric: str) -> Figure:
    """A metric over Td and K0, welded beside hard stop (the paper's Fig. 4 as a map)."""
    planes = [select(data, x="Td", y="K0", metric=metric) for data in (welded, contact)]
    return panels([("", plane) for plane in planes])


def period(data: xr.Dataset, metric: str) -> Figure:
    """A metric over K0 and the control period, welded beside hard stop."""
    contacts = ("welded", "hard_stop")
    planes = [select(data, x="K0", y="period", metric=metric, at={"contact": c}) for c in contacts]
    return panels([("", plane) for plane in planes])


def atlas(data: xr.Dataset, metric: str) -> Figure:
    """A metric over Kenv and K0 for three desired torques, below and above Fmax."""
    at = {"sigma": 0.01, "Denv": 100.0}
    torques = [{"Td": Td} | at for Td in (4.0, 10.0, 20.0)]
    planes = [select(data, x="Kenv", y="K0", metric=metric, at=cut) for cut in torques]
    return panels([("", plane) for plane in planes])


def search(data: xr.Dataset, metric: str) -> Figure:
    """A metric over K0 and the search resolution for three dampings of the environment."""
    cuts = [{"Denv": Denv, "Td": 4.0, "Kenv": 100.0} for Denv in (1.0, 30.0, 1000.0)]
    planes = [select(data, x="K0", y="sigma", metric=metric, at=cut) for cut in cuts]
    return panels([("", plane) for plane in planes])


def figures(results: Path) -> Iterator[tuple[str, Figure]]:
    """Name and figure of every picture, from the stores under `results`."""
    names = ("paper-welded", "paper-contact", "period-map", "atlas-small")
    welded, contact, periods, small = (dataset(results / f"{name}.zarr") for name in names)
    for metric in METRICS:
        yield f"paper-{metric}", paper(welded, contact, metric)
        yield f"period-{metric}", period(periods, metric)
        yield f"atlas-{metric}", atlas(small, metric)
        yield f"search-{metric}", search(small, metric)


def main() -> None:
    """Draw the stores in a folder; the pictures go into the same folder."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--readme", type=Path, help="write only the README's picture, to this file")
    arguments = parser.parse_args()
    if arguments.readme:
        save(atlas(dataset(arguments.results / "atlas-small.zarr"), "nmse_tail"), arguments.readme)
        return
    for name, figure in figures(arguments.results):
        save(figure, arguments.results / f"{name}.png")


if __name__ == "__main__":
    main()
