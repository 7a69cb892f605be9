"""`merge`: one store of all shards of a sweep."""

from pathlib import Path
from typing import Annotated

import typer

from sweeps.cli.arguments import NewStore, store
from sweeps.cli.interruption import raise_on_signals
from sweeps.cli.process import importing
from sweeps.cli.progress import blocks_counted


def merge(
    parts: Annotated[
        list[Path],
        typer.Argument(parser=store, metavar="PART...", help="stores that `run --shard` made"),
    ],
    out: NewStore = None,
    incomplete: Annotated[
        bool,
        typer.Option("--incomplete", help="also without some blocks, which `resume` then runs"),
    ] = False,
) -> None:
    """Make one store of the shards of a sweep."""
    raise_on_signals()
    with importing():
        from sweeps.cli.messages import merged
        from sweeps.merge import merge as merge_parts

    with blocks_counted("merge") as on_block:
        store = merge_parts(parts, out, incomplete, on_block)
    print(merged(store))
