"""The figures of the gallery from their stores: `python -m figures.atlas [FOLDER]`."""

import argparse
import shutil
from pathlib import Path

from figures.atlas import FIGURES, write
from figures.atlas.page import page

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("folder", type=Path, nargs="?", default=Path("results/atlas"))
parser.add_argument("--only", choices=FIGURES, help="one figure")
parser.add_argument("--docs", type=Path, help="also write gallery.md and its pictures there")
arguments = parser.parse_args()
if arguments.docs and arguments.only:
    parser.error("--docs writes the whole gallery, and --only draws one figure of it")
entries = dict(write(arguments.folder, [arguments.only] if arguments.only else list(FIGURES)))
if arguments.docs:
    (arguments.docs / "gallery").mkdir(parents=True, exist_ok=True)
    for name in entries:
        shutil.copy(arguments.folder / f"{name}.png", arguments.docs / "gallery")
    (arguments.docs / "gallery.md").write_text(page(list(entries.values())), encoding="utf-8")
