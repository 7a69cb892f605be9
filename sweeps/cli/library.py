"""The sweeps of the library: `list`, `show`, and finding one by its name."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sweeps import LIBRARY, unknown_sweep
from sweeps.cli.arguments import SweepName
from sweeps.cli.errors import complain, refuse

if TYPE_CHECKING:
    from sweeps.spec.types import Sweep


def list_() -> None:
    """Name the sweeps of the library."""
    from sweeps.plan.grid import Grid
    from sweeps.spec.reading import load

    for path in sorted(LIBRARY.glob("*.toml")):
        sweep = load(path)
        print(f"{sweep.name:20} {Grid(sweep).most_runs:>13,}  {sweep.description}")


def show(what: SweepName) -> None:
    """Print a sweep file, its size and its warnings."""
    from sweeps.cli.messages import held_lines, plan_lines
    from sweeps.plan.grid import Grid
    from sweeps.spec.reading import parse, read_text

    path = find(what)
    text = read_text(path)  # once: a pipe has nothing more
    sweep = parse(text, str(path))
    print(text.rstrip())
    print()
    for line in (*plan_lines(Grid(sweep), f"float{sweep.bits}"), *held_lines(sweep)):
        print(f"# {line}")
    warn(sweep)


def read(what: str, overrides: Sequence[str]) -> "Sweep":
    """The sweep of a name, a file or a store, changed by `--set`."""
    from sweeps.spec.reading import load
    from sweeps.store.opening import open_store

    if is_store(what):
        return open_store(Path(what)).sweep_again(overrides)
    return load(find(what), tuple(overrides))


def is_store(what: str) -> bool:
    """Whether a path is that of a result store."""
    return bool(what) and os.path.isfile(os.path.join(what, "zarr.json"))


def find(what: str) -> Path:
    """The file of a sweep: a path, or the name of a library sweep unless a file has that name.

    Refuses a store and a folder.
    """
    from sweeps.spec.mistakes import command, printable

    given, path = Path(what), LIBRARY / f"{what}.toml"
    if is_store(what):
        described = f"{command('status', given)} describes it"
        refuse(f"{printable(what)}: is a result store, no sweep file; {described}")
    if given.is_file() or "/" in what or what.endswith(".toml") or set(what) == {"."}:
        return given
    if path.is_file() and os.path.isfile(f"{what}.toml"):
        complain(f"warning: {what} is the library's sweep; {what}.toml is the file in this folder")
    if not path.is_file():
        raise unknown_sweep(what)
    return path


def warn(sweep: "Sweep", advice: bool = True) -> None:
    """Print what the user should know about an allowed sweep, on stderr."""
    from sweeps.spec.warnings import warnings_of

    for line in warnings_of(sweep, advice):
        complain(f"warning: {sweep.name}: {line}")
