"""The figures of a report's findings once more, from their data: `python -m figures.findings`."""

import argparse
from pathlib import Path

from figures.findings import redraw

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("folder", type=Path, nargs="?", default=Path("results/figures"))
redraw(parser.parse_args().folder)
