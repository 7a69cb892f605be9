"""`fic-sweep`, the command line. Only this folder prints, draws and measures.

- `library`: `list`, `show`; finds a sweep by its name or file
- `run`: `run`, `resume`
- `merge`: `merge`
- `reduce`: `reduce`
- `check`: `status`, `verify`
- `output`: `plot`, `history`, `export`
- `explore`: `explore`
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

import sys
from typing import Annotated

import typer

from sweeps.cli import (
    bench,
    check,
    errors,
    explore,
    library,
    merge,
    output,
    process,
    reduce,
    report,
    run,
)
from sweeps.cli.arguments import Command

app = typer.Typer(
    name="fic-sweep",
    context_settings={"help_option_names": ["-h", "--help"]},
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.command("list", cls=Command)(library.list_)
for command in (
    library.show,
    run.run,
    run.resume,
    merge.merge,
    reduce.reduce,
    check.verify,
    check.status,
    output.plot,
    output.history,
    output.export,
    output.share,
    explore.explore,
    bench.bench,
    report.report,
):
    app.command(cls=Command)(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        from fic_jax import __version__

        print(f"fic-sweep {__version__}")
        raise typer.Exit(0)


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="print it and exit"),
    ] = False,
) -> None:
    """Sweep the Fractal Impedance Controller over any of its parameters."""
    if context.invoked_subcommand is None:
        print(context.get_help(), file=sys.stderr)
        raise typer.Exit(2)


def main() -> None:
    """Entry point. Exit codes: 0 done, 1 failed or interrupted, 2 the request was wrong."""
    process.show_warnings_once()
    process.forget_other_programs()
    process.exit_with(lambda: errors.dispatch(app))
