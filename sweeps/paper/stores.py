"""The stores a report is made from: run where missing, resumed where unfinished."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from sweeps import runner
from sweeps.runner import Progress
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import load
from sweeps.store.opening import Store, open_store

PRECISION = 32  # bits of a store that is run here, as of `fic-sweep run`

Tell = Callable[[str, Progress], None]


def ensure(folder: Path, names: Iterable[str], library: Path, tell: Tell) -> dict[str, Path]:
    """Finished stores of library sweeps under `folder`: name -> path.

    Raises SweepError for a store that another program or another sweep made.
    """
    paths = {name: folder / f"{name}.zarr" for name in names}
    # all that are there first: what is wrong is told before anything runs
    there = {name: _reopened(path, library, name) for name, path in paths.items() if path.exists()}
    for name, path in paths.items():
        store = there.get(name) or runner.start(
            path, load(library / f"{name}.toml"), None, PRECISION
        )
        runner.run(store, partial(tell, name))
    return paths


def _reopened(path: Path, library: Path, name: str) -> Store:
    """A store that is there, to be used or continued in its own precision."""
    store = open_store(path)
    if store.grid.sweep.record() != load(library / f"{name}.toml").record():
        raise SweepError(
            f"{path}: holds another sweep than `{name}` of the library; remove it and `fic-sweep "
            "report` runs the sweep again, or name another folder with --results"
        )
    return runner.reopen(path, int(store.dtype.removeprefix("float")))
