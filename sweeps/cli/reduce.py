"""`reduce`: the statistics of a store over some of its dimensions, as a store."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sweeps.cli import interruption
from sweeps.cli.arguments import NewStore, StorePath
from sweeps.cli.errors import fail, refuse, system_errors_reported, unreadable_refused
from sweeps.cli.progress import blocks_counted

if TYPE_CHECKING:
    from sweeps.store.opening import Store


def reduce(
    path: StorePath,
    over: Annotated[
        list[str], typer.Option(metavar="DIMENSION,...", help="the dimensions that go")
    ],
    max_: Annotated[
        list[str] | None,
        typer.Option("--max", metavar="METRIC,...", help="largest values, and where they are"),
    ] = None,
    min_: Annotated[
        list[str] | None,
        typer.Option("--min", metavar="METRIC,...", help="smallest values, and where they are"),
    ] = None,
    mean: Annotated[
        list[str] | None, typer.Option(metavar="METRIC,...", help="means of these metrics")
    ] = None,
    std: Annotated[
        list[str] | None, typer.Option(metavar="METRIC,...", help="standard deviations of these")
    ] = None,
    quantile: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=PART,...", help="quantiles, as nmse=0.5,0.95"),
    ] = None,
    share: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME:CONDITION", help='part of the cells, as "calm: nmse_tail < 1e-3"'
        ),
    ] = None,
    best: Annotated[
        str | None,
        typer.Option(metavar="DIMENSION", help="goes too: all is at its best value by --by"),
    ] = None,
    by: Annotated[
        str | None, typer.Option(metavar="METRIC", help="its largest value decides what is best")
    ] = None,
    untrusted: Annotated[
        float | None,
        typer.Option(metavar="PART", help="of the cells may be not run or not trusted; default: 0"),
    ] = None,
    out: NewStore = None,
    chunk: Annotated[int | None, typer.Option(min=1, help="most cells of a block")] = None,
) -> None:
    """Reduce a store over some of its dimensions, into a new store."""
    stop = interruption.stop_on_signals()
    from sweeps.reduce.stored import reduce_store, reduced_sweep
    from sweeps.store.opening import open_store

    table: dict[str, Any] = {
        "over": _listed(over),
        "max": _listed(max_),
        "min": _listed(min_),
        "mean": _listed(mean),
        "std": _listed(std),
        "quantiles": dict(_quantiles(quantile)),
        "share": dict(_shares(share)),
        "best": best,
        "by": by,
        "untrusted": untrusted,
    }
    store = open_store(path)
    if untrusted is None:
        _refuse_unfinished(store)
    given = {key: value for key, value in table.items() if value not in (None, [], {})}
    with _options_named():
        sweep = reduced_sweep(store, given)
    target = out or path.with_name(f"{path.stem}-reduced.zarr")
    with unreadable_refused(path), system_errors_reported(target):
        try:
            with blocks_counted("reduce") as show:

                def on_block(done: int, blocks: int) -> None:
                    show(done, blocks)
                    stop.raise_if_requested()

                new = reduce_store(store, sweep, target, chunk, on_block)
        except KeyboardInterrupt:
            _interrupted(target)
    _say(store, new)


@contextmanager
def _options_named() -> Iterator[None]:
    """Name the options that the user typed in a mistake of the table that they make."""
    from sweeps.spec.mistakes import SweepError

    def option(key: re.Match[str]) -> str:
        name = {"quantiles": "quantile"}.get(key[1], key[1])
        return f"`--{name} {key[2]}`" if key[2] else f"`--{name}`"

    try:
        yield
    except SweepError as error:
        text = re.sub(r"`reduce\.(\w+)(?:\.([^`]*))?`", option, str(error))
        raise SweepError(text.replace("quantiles, share", "quantile, share")) from None


def _refuse_unfinished(store: "Store") -> None:
    """Raise SweepError for a store in which scenarios are missing: its answer would be too."""
    from sweeps.spec.mistakes import SweepError, command
    from sweeps.store.opening import Counts

    rest = "--untrusted 0.9 reduces what there is, if it is a tenth of a cell or more"
    if store.grid.shard:
        what = f"is shard {store.grid.shard} of a sweep: merge the parts first"
        raise SweepError(f"{store.path}: {what}; {rest}")
    if Counts.of(store).pending:
        left = f"{store.path}: scenarios are still to be run"
        raise SweepError(f"{left}; {command('resume', store.path)} runs them; {rest}")


def _say(store: "Store", new: "Store") -> None:
    from sweeps.cli.messages import counted, reduced_lines

    cells = counted(store.grid.cells, "scenario")
    print(f"wrote {new.path}: {counted(new.grid.cells, 'cell')} of {cells}")
    for line in reduced_lines(new):
        print(line)


def _interrupted(target: Path) -> None:
    from sweeps.cli.messages import interrupted
    from sweeps.store.opening import open_store

    fail(interrupted(open_store(target), KeyboardInterrupt()))


def _listed(given: list[str] | None) -> list[str]:
    """Names with commas between them, or in options of their own."""
    return [name.strip() for text in given or () for name in text.split(",")]


def _quantiles(given: list[str] | None) -> Iterator[tuple[str, list[float]]]:
    for text in given or ():
        metric, equals, parts = text.partition("=")
        try:
            numbers = [float(part) for part in parts.split(",")]
        except ValueError:
            numbers = []
        if not (equals and numbers):
            refuse(f"--quantile {text}: must be METRIC=PART,..., as in --quantile nmse=0.5,0.95")
        yield metric.strip(), numbers


def _shares(given: list[str] | None) -> Iterator[tuple[str, str]]:
    for text in given or ():
        name, colon, condition = (part.strip() for part in text.partition(":"))
        if not (name and colon and condition):
            example = '--share "calm: nmse_tail < 1e-3"'
            refuse(f"--share {text}: must be NAME:CONDITION, as in {example}")
        yield name, condition
