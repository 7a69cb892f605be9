"""`run` and `resume`: compute the blocks of a store."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sweeps.cli import interruption
from sweeps.cli.arguments import NewStore, StorePath
from sweeps.cli.errors import complain, fail, refuse, system_errors_reported
from sweeps.cli.library import find, is_store, read, warn
from sweeps.cli.process import importing
from sweeps.cli.progress import run_with_progress

if TYPE_CHECKING:
    from distributed import Client

    from sweeps.plan.shard import Shard
    from sweeps.spec.types import Sweep
    from sweeps.store.opening import Store


class Precision(StrEnum):
    """Bits of a number."""

    single = "32"
    double = "64"


class Device(StrEnum):
    """Where a sweep runs."""

    cpu = "cpu"
    gpu = "gpu"


Dask = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS|local:N", help="a Dask scheduler, or N workers of this machine"),
]


def run(
    what: Annotated[
        str, typer.Argument(metavar="NAME|FILE|STORE", help="library name, TOML file or a store")
    ],
    out: NewStore = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="change a value; a list or range is an axis"
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option(help="size, bytes and expected time only")] = False,
    precision: Annotated[
        Precision | None, typer.Option(help="bits of a number; default: the file's, or 32")
    ] = None,
    chunk: Annotated[int | None, typer.Option(min=1, help="most cells of a block")] = None,
    device: Annotated[Device | None, typer.Option(help="default: a GPU if JAX has one")] = None,
    error_estimate: Annotated[
        bool, typer.Option("--error-estimate", help="also store the error of every metric")
    ] = False,
    dask: Dask = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="K/N", help="one block of N, into NAME.K-of-N.zarr, new or begun"),
    ] = None,
) -> None:
    """Run a sweep into a new store."""
    stop = interruption.stop_on_signals()
    overrides = [*(set_ or []), *(["error_estimate=true"] if error_estimate else [])]
    overrides += [f"precision={precision}"] if precision else []
    with importing():
        from sweeps import runner
        from sweeps.plan.shard import Shard
        from sweeps.spec.overrides import refuse_repeated
        from sweeps.store.create import taken_back_if_refused
        from sweeps.store.opening import open_store

    share = Shard.parse(shard) if shard is not None else None
    refuse_repeated(set_ or [])
    sweep = read(what, overrides)
    if chunk is None and is_store(what) and not overrides:
        chunk = open_store(Path(what)).grid.block_cells
    runner.configure(sweep.bits, device and device.value)
    path = out or Path(f"{sweep.name}.zarr")
    path = share.part(path) if share else path
    _refuse_refined(sweep, dask)
    if dry_run:
        _print_plan(sweep, chunk, share)
        warn(sweep)
        if os.path.lexists(path):  # one may ask for the size before one removes it
            then = "continues it" if share else "needs another --out"
            complain(f"warning: {path} exists already: `run` {then}")
        else:
            runner.check_start(path, sweep, chunk, sweep.bits, share)
        return
    with _client(dask) as client, taken_back_if_refused(path):
        if share:
            store = runner.start_or_reopen(path, sweep, chunk, sweep.bits, share)
        else:
            store = runner.start(path, sweep, chunk, sweep.bits)
        warn(sweep)  # a refused sweep needs no warning
        _finish(store, stop, client)


def resume(
    path: StorePath,
    extend: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="a larger sweep; computes only what is new"),
    ] = None,
    budget: Annotated[
        int | None, typer.Option(min=1, help="most scenarios of a refined sweep, more than before")
    ] = None,
    dask: Dask = None,
) -> None:
    """Run the blocks of a store that are not done yet."""
    stop = interruption.stop_on_signals()
    with importing():
        from sweeps.refine.budget import with_budget
        from sweeps.spec.reading import load
        from sweeps.store import extend as extension

    if extend and budget:
        refuse("--extend and --budget: one of them; the larger sweep has its budget")
    source = str(find(extend)) if extend else str(path)
    larger = load(Path(source)) if extend else None
    with system_errors_reported(path):
        extension.recover(path)
        store = reopen(path)
        _refuse_refined(store.grid.sweep, dask)
        if budget:
            if not store.grid.sweep.refine:
                refuse(f"--budget {budget}: {path} is not refined, and runs all its scenarios")
            larger = store.sweep_again([f"budget={budget}"])
        if larger:
            grown = with_budget if store.grid.sweep.refine else extension.extend
            store = grown(store, larger, source)
            warn(larger, advice=False)  # a store keeps its dt and precision
            _warn_of_old_folder()
        else:
            store.check_done()
    with _client(dask) as client:
        _finish(store, stop, client)


def _refuse_refined(sweep: "Sweep", dask: str | None) -> None:
    if dask is not None:
        from sweeps.cluster import refuse_refined

        refuse_refined(sweep)


@contextmanager
def _client(place: str | None) -> "Iterator[Client | None]":
    """The Dask client of `--dask`, with its dashboard on stderr; None without the option."""
    if place is None:
        yield None
        return
    from sweeps import cluster

    with cluster.connected(place) as client:
        if link := cluster.dashboard(client):
            complain(f"dashboard {link}")
        yield client


def _warn_of_old_folder() -> None:
    """An extension replaces the store's folder: somebody may stand in it."""
    try:
        os.getcwd()
    except FileNotFoundError:
        complain('warning: the store has a new folder; `cd "$PWD"` enters it')


def reopen(path: Path) -> "Store":
    """Open a store to continue it, with JAX in the store's precision and on its platform."""
    from sweeps import runner
    from sweeps.store.opening import open_store

    store = open_store(path)
    store.check_definition()  # before JAX starts
    precision = int(store.dtype.removeprefix("float"))
    runner.configure(precision, str(store.group.attrs.get("platform", "cpu")))
    return runner.reopen(path, precision)


def _print_plan(sweep: "Sweep", chunk: int | None, shard: "Shard | None") -> None:
    from sweeps.cli.messages import expectation, held_lines, plan_lines
    from sweeps.plan.grid import Grid
    from sweeps.runner import measure

    grid, dtype = Grid(sweep, chunk, shard), f"float{sweep.bits}"
    for line in (*plan_lines(grid, dtype), *held_lines(sweep)):
        print(line)
    print(expectation(grid, *measure(grid, dtype)))


def _finish(store: "Store", stop: interruption.Stop, client: "Client | None") -> None:
    """Run a store to its end and print the result; an error leaves finished blocks as they are."""
    from sweeps.cli.messages import failed_blocks, interrupted, summary
    from sweeps.runner import run as run_store
    from sweeps.store.opening import Counts, open_store

    run_blocks = None
    if client:
        from sweeps.cluster import Cluster

        run_blocks = Cluster(client, store).run_blocks
    try:
        result = run_with_progress(store, stop, run_blocks)
    except (KeyboardInterrupt, OSError) as error:
        if isinstance(error, OSError) or Counts.of(store).pending:
            fail(interrupted(store, error))
        # The stop came during the last block: only the time of the end is missing.
        result = run_store(store, lambda _: None)
    with system_errors_reported(store.path):
        print(summary(open_store(store.path), result))
    if result.set_aside:
        fail("\n".join(failed_blocks(store, result)))
