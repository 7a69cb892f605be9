"""Sweeps: from a sweep file to a store of results, and on to tables, pictures and the report.

- `spec`: reads and checks a sweep file; `library`: the sweeps that come with the program
- `plan`: its scenarios, block by block
- `store`: the result store on disk
- `merge`: one store of the shards of a sweep
- `reduce`: the statistics of a reduced store, from cells that are computed or read
- `refine`: which cells of a refined store are simulated, round after round
- `runner`: computes the blocks of a store; `provenance`: names the program and the machine
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

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import Client

    from sweeps.runner import OnProgress, Progress
    from sweeps.spec.types import Sweep
    from sweeps.store.opening import Store

LIBRARY = Path(__file__).parent / "library"


def load(sweep: "str | Path") -> "Sweep":
    """A sweep of the library, by its name, or of a sweep file, by its path.

    Raises SweepError, with a line for each mistake in the file.
    """
    from sweeps.spec import reading
    from sweeps.spec.mistakes import SweepError, hint, printable

    path = Path(sweep)
    if isinstance(sweep, str) and "/" not in sweep and not sweep.endswith(".toml"):
        library = {file.stem: file for file in sorted(LIBRARY.glob("*.toml"))}
        path = library.get(sweep, path)
        if not path.exists():
            known = hint(sweep, library)
            raise SweepError(f"{printable(sweep)}: is no file and no sweep of the library{known}")
    try:
        return reading.load(path)
    except SweepError as error:
        raise error.with_traceback(None) from None


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

    The run has the precision of the sweep, and JAX that of the caller again afterwards.

    A block that could not be computed is set aside: `Counts.of(store).set_aside` names it. Raises
    SweepError for a wrong request, OSError if the disk or the cluster fails, KeyboardInterrupt
    after Ctrl-C, or a notebook's stop button, and the block that is being computed (at once after
    a second one); finished blocks stay.
    """
    from sweeps.spec.mistakes import SweepError

    try:
        with _stopped_between_blocks(on_progress or (lambda _: None)) as report:
            return _run(sweep, path, client, chunk, report)
    except (SweepError, KeyboardInterrupt) as error:
        raise error.with_traceback(None) from None


@contextmanager
def _stopped_between_blocks(on_progress: "OnProgress") -> "Iterator[OnProgress]":
    """A callback that calls `on_progress` with news, and raises after a block if SIGINT came.

    An exception inside XLA's compiler may crash the process, and its traceback has 100 lines.
    Other threads get no signals, and a handler of the user's own stays.
    """
    ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    requested, last = False, None

    def request(_signum: int, _frame: object) -> None:
        nonlocal requested
        requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)  # the second one raises at once

    def report(progress: "Progress") -> None:
        nonlocal last
        if progress != last:  # a cluster reports twice a second, so that a stop is seen
            last = progress
            on_progress(progress)
        if requested and progress.done < progress.cells:
            raise KeyboardInterrupt("stopped after a block; the same call continues")

    if ours:
        signal.signal(signal.SIGINT, request)
    try:
        yield report
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _run(
    sweep: "Sweep | str | Path",
    path: "str | Path | None",
    client: "Client | None",
    chunk: int | None,
    on_progress: "OnProgress",
) -> "Store":
    import jax

    from sweeps import runner
    from sweeps.store.create import taken_back_if_refused
    from sweeps.store.opening import open_store

    if isinstance(sweep, str | Path):
        sweep = load(sweep)
    if client:
        from sweeps.cluster import refuse_refined

        refuse_refined(sweep)
    place = Path(path or f"{sweep.name}.zarr")
    callers = jax.config.jax_enable_x64  # type: ignore[attr-defined]
    try:
        with suppress(RuntimeError):  # JAX has started, as the caller wants it
            runner.configure(sweep.bits)
        jax.config.update("jax_enable_x64", sweep.bits == 64)
        with taken_back_if_refused(place):
            store = runner.start_or_reopen(place, sweep, chunk, sweep.bits, None)
            run_blocks = None
            if client:
                from sweeps.cluster import Cluster

                run_blocks = Cluster(client, store).run_blocks
            runner.run(store, on_progress, run_blocks=run_blocks)
        return open_store(store.path)
    finally:
        jax.config.update("jax_enable_x64", callers)
