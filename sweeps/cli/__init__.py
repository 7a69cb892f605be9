"""`fic-sweep`, the command line. Only this folder prints, draws and measures.

- `library`: `list`, `show`; finds a sweep by its name or file
- `run`: `run`, `resume`
- `check`: `status`, `verify`
- `output`: `plot`, `history`, `export`
- `report`, `bench`: a command each
- `arguments`: the arguments that several commands share
- `interruption`: Ctrl-C and SIGTERM stop a command between two blocks
- `progress`: a bar on a terminal, lines in a log
- `messages`: what the commands print, as text
- `errors`: the one line and the exit code of a command that fails
- `process`: start and end of the process, both quick

No file here imports jax, numpy or another large package at its top, so that `--help` is quick:
a command imports what it needs when it runs.
"""

import os
import sys
import warnings
from typing import Annotated

import typer

from sweeps.cli import bench, check, errors, library, output, process, report, run

app = typer.Typer(
    name="fic-sweep",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.command("list")(library.list_)
app.command()(library.show)
app.command()(run.run)
app.command()(run.resume)
app.command()(check.verify)
app.command()(check.status)
app.command()(output.plot)
app.command()(output.history)
app.command()(output.export)
app.command()(bench.bench)
app.command()(report.report)


def _print_version(wanted: bool) -> None:
    if wanted:
        from fic_jax import __version__

        print(f"fic-sweep {__version__}")
        raise typer.Exit(0)


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="print it and exit"),
    ] = False,
) -> None:
    """Sweep the Fractal Impedance Controller over any of its parameters."""


def main() -> None:
    """Entry point. Exit codes: 0 done, 1 failed or interrupted, 2 the request was wrong."""
    warnings.showwarning = lambda message, *_, **__: print(
        f"fic-sweep: warning: {message}", file=sys.stderr
    )
    # matplotlib refuses to be imported with a backend that it does not know; no picture needs one
    os.environ.pop("MPLBACKEND", None)
    process.exit_with(lambda: errors.dispatch(app))
