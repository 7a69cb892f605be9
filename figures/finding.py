"""The data that a report keeps of its findings, and the drawing of one finding from it."""

import argparse
from collections.abc import Callable
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from figures.style import save


def keep(data: xr.Dataset, folder: Path, name: str) -> Path:
    """Write the small data of a finding beside its picture, NAME.nc."""
    path = folder / f"{name}.nc"
    data.to_netcdf(
        path, engine="scipy"
    )  # NetCDF 3: scipy is there, a library for newer ones is not
    return path


def kept(folder: Path, name: str) -> xr.Dataset:
    """The data of a finding that `keep` has written."""
    return xr.load_dataset(folder / f"{name}.nc", engine="scipy")


def draw(name: str, plot: Callable[[xr.Dataset], Figure]) -> None:
    """Draw a finding again from the folder of a report's pictures, into that folder."""
    parser = argparse.ArgumentParser(description=f"Draw {name} from what `fic-sweep report` kept.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("results/figures"))
    folder = parser.parse_args().folder
    save(plot(kept(folder, name)), folder / f"{name}.png")
