"""What every picture must keep, so that it can be read in a column of 3.4 inches, also in grey."""

import re

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.text import Text

SMALLEST = 6.0 * 3.5 / 3.4  # point
CONTRAST = 3.0  # of a line on white: what WCAG 2 asks of graphics
REFERENCES = {
    to_rgba(grey) for grey in ("0.8", "0.88", "0.6", "0.55")
}  # thin lines behind the data


def luminance(colour) -> float:
    """Relative luminance, 0 to 1, of sRGB on white."""
    red, green, blue, alpha = to_rgba(colour)
    channels = alpha * np.array([red, green, blue]) + 1.0 - alpha
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(colour) -> float:
    """Contrast with white, 1 to 21."""
    return 1.05 / (luminance(colour) + 0.05)


def check(figure: Figure) -> None:
    """Assert letters of 6 pt, lines that can be seen, and words where words are wanted."""
    FigureCanvasAgg(figure).draw()
    texts = [
        text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()
    ]
    for text in texts:
        assert text.get_fontsize() >= SMALLEST - 1e-6, text
    for axes in figure.axes:
        if any(isinstance(item, QuadMesh) for item in axes.collections):
            continue  # lines over a map have edges
        for line in axes.lines:
            if line.get_visible() and to_rgba(line.get_color()) not in REFERENCES:
                assert contrast(line.get_color()) >= CONTRAST, (axes.get_ylabel(), line)
    titles = [axes.get_title(loc) for axes in figure.axes for loc in ("left", "center", "right")]
    labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    for title in (*titles, figure.get_suptitle(), *labels):
        assert not re.search(r"[a-z]_[a-z]|algorithm1", re.sub(r"\$.*?\$", "", title)), title
