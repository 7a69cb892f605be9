"""Figures of stored sweeps. A figure is a pure function of a Dataset; only `main` reads and saves.

- `planes`: cuts the plane of a heatmap out of a store
- `heatmap`: draws one plane (`plot`) or a row of planes under one colour scale (`panels`)
- `hatch`: marks the cells without a value and those that are not trusted
- `style`: sizes, symbols, colours, number formats, and `save`
- `overview`: the pictures of `make sweep`; `precision`: float32 beside float64
- `report` and the files named after findings: the pictures of `fic-sweep report`
- `maps`, `finding`: what those share; `paper`: the paper's own figures

`fic-sweep plot` is `save(plot(dataset(path), ...))`: Dataset -> Plane -> Figure -> file.
"""

from figures.heatmap import panels, plot
from figures.planes import Plane, PlotError, select
from figures.style import save

__all__ = ["Plane", "PlotError", "panels", "plot", "save", "select"]
