"""Figures of stored sweeps. A figure is a pure function of a Dataset; only `main` reads and saves.

- `cut`: takes a part of a store: some dimensions drawn, the others fixed; what each cell is
- `planes`: two dimensions; `heatmap` draws one plane or a row (`panels`) under one colour scale
- `points`: one dimension, as a line or as dots
- `choose`: which of them a request names
- `ticks`, `colours`, `border`, `hatch`, `mesh`, `caption`: parts of these pictures, and their words
- `history`: time histories of named cells
- `style`: sizes, symbols, colours, number formats, and `save`
- `overview`: the pictures of `make sweep`; `precision`: float32 beside float64
- `atlas`: the gallery, from the sweeps of `make atlas`
- `report`, `findings`: the pictures of `fic-sweep report`; `paper`: the paper's own figures

`fic-sweep plot` is `save(draw(choose(dataset(path), ...)), file)`: Dataset -> Plane or Points ->
Figure -> file.
"""

from figures.choose import choose, draw, plot
from figures.cut import PlotError
from figures.heatmap import panels
from figures.planes import Plane, select
from figures.points import Points
from figures.style import save

__all__ = ["Plane", "PlotError", "Points", "choose", "draw", "panels", "plot", "save", "select"]
