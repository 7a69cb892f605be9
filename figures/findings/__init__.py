"""The figures of the report's findings: `plot(data)` of a file draws what the study of that name,
in sweeps/paper/findings/, has measured.

The report writes the data beside the picture; `python -m figures.findings [FOLDER]` draws them
again.
"""

from pathlib import Path

import xarray as xr

from figures.findings import (
    explanation,
    limit_cycle,
    online_gains,
    readings,
    saturation,
    search_resolution,
    variable_step,
)
from figures.style import save

PLOTS = {
    "explanation": explanation.plot,
    "limit_cycle": limit_cycle.plot,
    "online_gains": online_gains.plot,
    "readings": readings.plot,
    "saturation": saturation.plot,
    "search_resolution": search_resolution.plot,
    "variable_step": variable_step.plot,
}


def write(data: xr.Dataset, folder: Path, name: str) -> None:
    """Draw NAME.png into a folder, and write its small data beside it, NAME.nc."""
    # NetCDF 3 needs scipy alone
    data.to_netcdf(folder / f"{name}.nc", engine="scipy")
    save(PLOTS[name](data), folder / f"{name}.png")


def redraw(folder: Path) -> None:
    """Draw the pictures whose data are in a folder."""
    for name, plot in PLOTS.items():
        if (folder / f"{name}.nc").exists():
            data = xr.load_dataset(folder / f"{name}.nc", engine="scipy")
            save(plot(data), folder / f"{name}.png")
