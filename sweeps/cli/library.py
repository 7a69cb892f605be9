"""The sweeps of the library: `list`, `show`, and finding one by its name."""

import os
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
    from sweeps.cli.messages import plan_lines
    from sweeps.plan.grid import Grid
    from sweeps.spec.reading import load

    path = find(what)
    sweep = load(path)
    print(path.read_text(encoding="utf-8").rstrip())
    print()
    for line in plan_lines(Grid(sweep), f"float{sweep.bits}"):
        print(f"# {line}")
    warn(sweep)


def read(what: str, overrides: Sequence[str]) -> "Sweep":
    """The sweep of a name, a file or a store, changed by `--set`."""
    from sweeps.spec.reading import load
    from sweeps.store.opening import open_store

    if os.path.isfile(os.path.join(what, "zarr.json")):
        return open_store(Path(what)).sweep_again(overrides)
    return load(find(what), tuple(overrides))


def find(what: str) -> Path:
    """The file of a sweep: a path, or the name of a library sweep unless a file has that name."""
    if Path(what).is_file() or "/" in what or what.endswith(".toml"):
        return Path(what)
    path = LIBRARY / f"{what}.toml"
    if not path.is_file():
        from sweeps.spec.mistakes import hint, printable

        names = sorted(path.stem for path in LIBRARY.glob("*.toml"))
        known = hint(what, names)
        refuse(f"{printable(what)}: is no file and no sweep of the library{known}")
    return path


def warn(sweep: "Sweep") -> None:
    """Print what the user should know about an allowed sweep, on stderr."""
    from sweeps.spec.warnings import warnings_of

    for line in warnings_of(sweep):
        complain(f"warning: {sweep.name}: {line}")
