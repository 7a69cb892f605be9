"""The pictures of `fic-sweep report`: one for each finding, and the paper's figures."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import xarray as xr

from figures import (
    limit_cycle,
    online_gains,
    readings,
    saturation,
    search_resolution,
    variable_step,
)
from figures.finding import keep
from figures.paper.__main__ import SCRIPTS
from figures.style import save

FINDINGS = {
    "limit_cycle": limit_cycle,
    "online_gains": online_gains,
    "readings": readings,
    "saturation": saturation,
    "search_resolution": search_resolution,
    "variable_step": variable_step,
}


def draw(folder: Path, findings: Mapping[str, xr.Dataset]) -> Iterator[str]:
    """Write every picture into `folder`, and the data of the findings; yields each stem."""
    for name, data in findings.items():
        keep(data, folder, name)
        save(FINDINGS[name].plot(data), folder / f"{name}.png")
        yield name
    for script in SCRIPTS:
        yield from script.main(folder)
