"""The sweeps of the library: `list`, `show`, and finding one by its name."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sweeps import LIBRARY
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
        print(f"{sweep.name:16} {Grid(sweep).cells:>12,}  {sweep.description}")


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
    return os.path.isfile(os.path.join(what, "zarr.json"))


def find(what: str) -> Path:
    """The file of a sweep: a path, or the name of a library sweep unless a file has that name.

    Refuses a store and a folder.
    """
    place, path = Path(what), LIBRARY / f"{what}.toml"
    if is_store(what):
        quoted = shlex.quote(what)
        refuse(
            f"{what}: is a result store, no sweep file; `fic-sweep status {quoted}` describes it"
        )
    if os.path.isdir(what) and not (what and path.is_file()):
        refuse(f"{what or '(nothing)'}: is a folder, no sweep file")
    if place.is_file() or "/" in what or what.endswith(".toml"):
        return place
    if path.is_file() and os.path.isfile(f"{what}.toml"):
        complain(
            f"warning: {what} is a sweep of the library; for the file in this folder, write "
            f"{what}.toml"
        )
    if not path.is_file():
        from sweeps.spec.mistakes import hint

        names = sorted(path.stem for path in LIBRARY.glob("*.toml"))
        refuse(f"{what}: is no file and no sweep of the library{hint(what, names)}")
    return path


def warn(sweep: "Sweep") -> None:
    """Print what the user should know about an allowed sweep, on stderr."""
    from sweeps.spec.warnings import warnings_of

    for line in warnings_of(sweep):
        complain(f"warning: {sweep.name}: {line}")
