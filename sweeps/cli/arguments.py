"""Arguments that several commands share."""

from pathlib import Path
from typing import Annotated

import typer


def folder(typed: str) -> Path:
    """A folder to write into. Raises SweepError as `place` does."""
    from sweeps.store.place import place

    return place(typed)


def store(typed: str) -> Path:
    """The place of a store. Raises SweepError as `place_of_store` does."""
    from sweeps.store.place import place_of_store

    return place_of_store(typed)


def new(typed: str) -> Path:
    """The place of a new file or store. Raises SweepError as `place_of_new` does."""
    from sweeps.store.place import place_of_new

    return place_of_new(typed)


SweepName = Annotated[str, typer.Argument(metavar="NAME|FILE", help="library name or TOML file")]
StorePath = Annotated[Path, typer.Argument(parser=store, metavar="PATH", help="a result store")]
NewStore = Annotated[
    Path | None, typer.Option(parser=new, metavar="PATH", help="the store to write")
]
NewFile = Annotated[Path | None, typer.Option(parser=new, metavar="FILE", help="the file to write")]
