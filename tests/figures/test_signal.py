"""A signal is a line, or, where it oscillates too fast for one, a band."""

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from figures import signal

WIDTH = 100.0  # point: 25 stretches
T = np.linspace(0.0, 10.0, 5001)


def drawn(y):
    axes = Figure().subplots()
    band = signal.draw(axes, T, y, WIDTH, color="k", ls="--")
    assert band == any(isinstance(c, PolyCollection) for c in axes.collections)
    return axes.lines[0].get_ydata(), axes


def test_a_slow_signal_is_a_line():
    y = np.sin(2 * np.pi * T / 2.0) + 0.01 * np.sin(2 * np.pi * 20 * T)  # the ripple is thin
    line, axes = drawn(y)
    np.testing.assert_array_equal(line, y)
    assert not axes.collections


def test_a_fast_signal_is_the_band_between_its_peaks():
    """It was a block of ink."""
    line, axes = drawn(3.0 * np.sin(2 * np.pi * 20 * T))
    assert np.isnan(line).all()
    box = axes.collections[0].get_paths()[0].get_extents()
    assert [box.x0, box.x1, box.y0, box.y1] == pytest.approx([0.0, 10.0, -3.0, 3.0], abs=0.02)


def test_a_signal_that_becomes_slow_goes_on_as_a_line_and_no_peak_is_lost():
    y = np.where(T < 5.0, np.sin(2 * np.pi * 20 * T), 0.5)
    y[100] = 7.0
    line, axes = drawn(y)
    assert np.isnan(line[T < 4.0]).all() and (line[T > 6.0] == 0.5).all()
    assert axes.collections[0].get_paths()[0].vertices[:, 1].max() == 7.0


def test_a_single_spike_stays_a_line():
    y = np.where(np.abs(T - 3.0) < 0.05, 40.0, 0.0)
    np.testing.assert_array_equal(drawn(y)[0], y)
