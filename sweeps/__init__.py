"""Sweeps: from a sweep file to a store of results, and on to tables, pictures and the report.

- `spec`: reads and checks a sweep file; `library`: the sweeps that come with the program
- `plan`: its scenarios, block by block
- `store`: the result store on disk
- `merge`: one store of the shards of a sweep
- `reduce`: the statistics of a reduced store, from cells that are computed or read
- `refine`: which cells of a refined store are simulated, round after round
- `runner`: computes the blocks of a store; `provenance`: names the program and the machine
- `stopping`: Ctrl-C during `sweeps.run`
- `cluster`: the blocks of a store on the workers of a Dask client; `worker`: what each worker does
- `devices`: starts JAX, or names the variable of the environment that keeps it from starting
- `compile_cache`, `processor`: where compiled programs are kept, one folder for each processor
- `disk`: which errors are the disk's and no mistake of the user
- `export`: a store as CSV, Parquet or NetCDF
- `maps`: what a picture of a metric shows, whoever draws it
- `explore`: maps in the browser
- `paper`: the paper's scenarios and claims, and the report about them
- `cli`: the command `fic-sweep`

From Python, `sweeps.run` does what the command `run` does, and `sweeps.load` reads a sweep file.
Both raise a SweepError without the frames below them: a notebook shows every frame of a traceback.

Imports point one way: cli -> paper -> runner -> {reduce, refine} -> store -> plan -> spec ->
fic_jax.
"""

import warnings
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import Client

    from sweeps.runner import OnProgress
    from sweeps.spec.mistakes import SweepError
    from sweeps.spec.types import Sweep
    from sweeps.store.opening import Store

LIBRARY = Path(__file__).parent / "library"


def load(sweep: "str | Path") -> "Sweep":
    """A sweep of the library, by its name, or of a sweep file, by its path.

    Raises SweepError, with a line for each mistake in the file.
    """
    from sweeps.spec import reading
    from sweeps.spec.mistakes import SweepError

    if not isinstance(sweep, str | Path):
        wanted = "a Sweep, the path of a sweep file or a name of the library"
        raise SweepError(f"sweep must be {wanted}, not {sweep!r}")
    path, is_name = Path(sweep), isinstance(sweep, str) and "/" not in sweep
    if is_name and (LIBRARY / f"{sweep}.toml").is_file():
        path = LIBRARY / f"{sweep}.toml"
    elif is_name and path.suffix != ".toml" and not path.exists():
        raise unknown_sweep(str(sweep))
    try:
        return reading.load(path)
    except SweepError as error:
        raise error.with_traceback(None) from None


def unknown_sweep(name: str) -> "SweepError":
    """The error for a name that is neither a file nor a sweep of the library."""
    from sweeps.spec.mistakes import SweepError, hint, printable

    if name.endswith(".zarr"):
        return SweepError(f"{printable(name)}: is no result store: there is nothing of this name")
    known = hint(name, sorted(path.stem for path in LIBRARY.glob("*.toml")))
    return SweepError(f"{printable(name)}: is no file and no sweep of the library{known}")


def run(
    sweep: "Sweep | str | Path",
    path: "str | Path | None" = None,
    *,
    client: "Client | None" = None,
    chunk: int | None = None,
    on_progress: "OnProgress | None" = None,
) -> "Store":
    """Run a sweep into the store `path`, or what is left of it if the store has been begun.

    sweep: a sweep, the path of its file, or a name of the library
    path: default NAME.zarr
    client: a `distributed.Client`, whose workers compute the blocks; None: this process does
    chunk: most cells of a block
    on_progress: is called with a `runner.Progress` after each block; `print` shows a line for each

    The run has the precision of the sweep, whatever JAX's is.

    A block that could not be computed is set aside: `Counts.of(store).set_aside` names it. Raises
    SweepError for a wrong request, OSError if the disk or the cluster fails, KeyboardInterrupt
    after Ctrl-C, or a notebook's stop button, and the block that is being computed (after a second
    one, its part that is being computed); finished blocks stay. What may surprise in the sweep is a
    warning.
    """
    from sweeps.spec.mistakes import SweepError
    from sweeps.stopping import stopped_between_blocks

    try:
        with stopped_between_blocks(on_progress or (lambda _: None)) as report:
            return _run(sweep, path, client, chunk, report)
    except (SweepError, KeyboardInterrupt) as error:
        raise error.with_traceback(None) from None


def _run(
    sweep: "Sweep | str | Path",
    path: "str | Path | None",
    client: "Client | None",
    chunk: int | None,
    on_progress: "OnProgress",
) -> "Store":
    from sweeps import runner
    from sweeps.spec.types import Sweep
    from sweeps.spec.warnings import warnings_of
    from sweeps.store.create import taken_back_if_refused
    from sweeps.store.opening import open_store

    if not isinstance(sweep, Sweep):
        sweep = load(sweep)
    if client:
        from sweeps.cluster import refuse_refined

        refuse_refined(sweep)
    place = Path(path or f"{sweep.name}.zarr")
    with suppress(RuntimeError):  # JAX has started, as the caller wants it
        runner.prepare()
    with taken_back_if_refused(place):
        store = runner.start_or_reopen(place, sweep, chunk, sweep.bits, None)
        for line in warnings_of(sweep, advice=False):
            warnings.warn(f"{sweep.name}: {line}", stacklevel=3)
        run_blocks = None
        if client:
            from sweeps.cluster import Cluster

            run_blocks = Cluster(client, store).run_blocks
        runner.run(store, on_progress, run_blocks=run_blocks)
    return open_store(store.path)
