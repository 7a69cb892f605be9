"""What a failed command says on stderr, and its exit code.

1: the run failed or was interrupted; finished blocks stay. 2: the request was wrong.
"""

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import typer

from sweeps import disk


def dispatch(app: typer.Typer) -> int:
    """Run the command that the process was started with; returns its exit code.

    Raises only what is a mistake in this program: its traceback is worth reading.
    """
    try:
        code = typer.main.get_command(app)(standalone_mode=False) or 0
        return 1 if code == 130 else code  # typer's code for Ctrl-C
    except typer.Exit as stop:
        return stop.exit_code
    except (KeyboardInterrupt, typer.Abort):
        complain("interrupted")
        return 1
    except Exception as error:
        message = _wrong_request(error)
        if message is not None:
            complain(message)
            return 1 if disk.refused(error) else 2
        if isinstance(error, OSError | MemoryError):  # the system refused, nobody knows what for
            complain(f"failed: {error or 'out of memory'}")
            return 1
        raise


def _wrong_request(error: Exception) -> str | None:
    """What to say if the request was wrong; None if the program was."""
    if hasattr(error, "format_message"):  # typer refused an option
        text = " ".join(str(error.format_message()).split())
        return text.replace("Value error, ", "").replace("Input should be", "must be")
    if message := _variables_of_jax(error):
        return message
    from sweeps.spec.mistakes import SweepError

    if isinstance(error, OSError) and error.filename:  # a name too long, a folder of another user
        return f"{error.filename}: {error.strerror}"
    return str(error) if isinstance(error, SweepError) else None


def _variables_of_jax(error: Exception) -> str | None:
    """What to say if JAX can't be imported with the variables that are set for it."""
    found = [f"{name}={value}" for name, value in os.environ.items() if name.startswith("JAX_")]
    for cause in filter(None, (error, error.__cause__)):
        frames = [frame for frame, _ in traceback.walk_tb(cause.__traceback__)]
        modules = {f.f_globals["__name__"] for f in frames if f.f_code.co_name == "<module>"}
        if found and "jax" in modules:
            return f"{' '.join(found)}: JAX can't start: {cause}"
    return None


def complain(message: str) -> None:
    """Print a message on stderr, each line after the program's name."""
    for line in message.splitlines():
        print(f"fic-sweep: {line}", file=sys.stderr)


def refuse(message: str) -> NoReturn:
    """Print a message and exit with 2."""
    complain(message)
    raise typer.Exit(2)


def fail(message: str) -> NoReturn:
    """Print a message and exit with 1."""
    complain(message)
    raise typer.Exit(1)


@contextmanager
def unreadable_refused(path: Path) -> Iterator[None]:
    """Refuse a damaged store in one line, not with the traceback of zarr."""
    try:
        yield
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        if isinstance(error, typer.Exit) or disk.refused(error):
            raise
        if isinstance(error, OSError) and error.filename:
            refuse(f"{path}: can't be read: {error.filename}: {error.strerror}")
        refuse(f"{path}: can't be read: {str(error).splitlines()[0][:200]}")


@contextmanager
def system_errors_reported(path: Path) -> Iterator[None]:
    """Report in one line what the system refused while a command changed or read a store."""
    from sweeps.cli.messages import system_error

    try:
        yield
    except OSError as error:
        fail(system_error(path, error))
