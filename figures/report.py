"""The pictures of `fic-sweep report`: the paper's figures, and one for each finding beyond it."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path

import xarray as xr

from figures.paper import look
from figures.paper.__main__ import SCRIPTS
from figures.style import save


def draw(folder: Path, findings: Mapping[str, xr.Dataset]) -> Iterator[str]:
    """Write every picture into `folder`; yields the stem of each once it is there."""
    for name, data in findings.items():
        try:
            save(import_module(f"figures.{name}").plot(data), folder / f"{name}.png")
        except ModuleNotFoundError:
            continue
        yield name
    for script in SCRIPTS:
        before = {p.stem for p in folder.glob("*.png")}
        look.FOLDER = folder
        script.main()
        yield from sorted({p.stem for p in folder.glob("*.png")} - before)
