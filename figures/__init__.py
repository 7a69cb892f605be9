"""Figures of stored sweeps: pure functions from a dataset to a matplotlib Figure."""

from figures.heatmap import panels, plot
from figures.planes import PlotError, Slice, select
from figures.style import save

__all__ = ["PlotError", "Slice", "panels", "plot", "save", "select"]
