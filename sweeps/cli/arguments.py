"""Arguments that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

SweepName = Annotated[str, typer.Argument(metavar="NAME|FILE", help="library name or TOML file")]
StorePath = Annotated[Path, typer.Argument(metavar="PATH", help="a result store")]
