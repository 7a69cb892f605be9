"""The pictures of `fic-sweep report`: one for each finding, and the paper's figures."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import xarray as xr

from figures import findings, paper


def draw(folder: Path, data: Mapping[str, xr.Dataset]) -> Iterator[str]:
    """Write every picture into `folder`, and the data of the findings; yields each stem."""
    for name, one in data.items():
        findings.write(one, folder, name)
        yield name
    yield from paper.write(folder)
