"""`plot`, `history`, `export` and `share`: a store as a picture, table, NetCDF file or page."""

import importlib.util
import itertools
import logging
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sweeps import disk
from sweeps.cli.arguments import NewFile, StorePath
from sweeps.cli.errors import complain, fail, refuse, unreadable_refused

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

    from sweeps.explore.stored import Stored
    from sweeps.explore.view import View

At = Annotated[
    list[str] | None,
    typer.Option(metavar="KEY=VALUE ...", help="values of other dimensions: --at Td=5 Kenv=100"),
]
# a command line has no option that takes several words: those after the first come as arguments
More = Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE", hidden=True)]
Force = Annotated[bool, typer.Option("--force", help="replace the file if it exists")]


class Format(StrEnum):
    """What `export` writes."""

    csv = "csv"
    parquet = "parquet"
    netcdf = "netcdf"


def plot(
    path: StorePath,
    more: More = None,
    x: Annotated[str | None, typer.Option(help="horizontal axis: dimension or field")] = None,
    y: Annotated[str | None, typer.Option(help="vertical axis; without it, the metric")] = None,
    metric: Annotated[str | None, typer.Option(help="what is shown; default: nmse")] = None,
    at: At = None,
    out: NewFile = None,
    force: Force = False,
) -> None:
    """Draw a metric: a heatmap over two dimensions, a line over one, dots for a random design."""
    values = _values(at, more)
    wanted = _single(values)
    _refuse_existing(out, force)
    check_matplotlib()
    from figures import choose, draw
    from sweeps.store.opening import dataset

    data = dataset(path)
    metric = metric or _first(data)
    with unreadable_refused(path), _plot_errors_refused(path):
        picture = choose(data, x=x, y=y, metric=metric, at=wanted)
    axes = [axis.name for axis in (picture.x, picture.y) if axis]
    target = out or _named(path, metric, *axes, *_cut(picture.cut))
    _warn_of_nearest(path, values, [picture.cut])
    _refuse_existing(target, force)
    _save(draw(picture), target, data)
    _say_where(values, picture.cut)


def _first(data: "xr.Dataset") -> str:
    """The metric of a picture by default: nmse, or the first answer of a reduction."""
    names = [str(name) for name in data.data_vars if data[name].dtype.kind == "f"]
    answers = [name for name in names if not name.endswith("_share")] or names
    by = [name for name in answers if name.endswith("_at_best")]
    return "nmse" if "nmse" in data or not answers else (by or answers)[0]


def history(
    path: StorePath,
    more: More = None,
    at: At = None,
    out: NewFile = None,
    force: Force = False,
) -> None:
    """Draw the motion of named cells, run anew. Several values of a KEY: a line for each."""
    values = _values(at, more)
    _refuse_existing(out, force)
    check_matplotlib()
    from figures.history import History, select, simulate
    from figures.history import plot as draw
    from sweeps import runner
    from sweeps.store.opening import dataset, open_store

    data, store = dataset(path), open_store(path)
    if store.grid.sweep.reduce:
        refuse(f"{path}: is reduced, and a cell of it has no motion; name a store of all its cells")
    wanted = [dict(zip(values, cell, strict=True)) for cell in itertools.product(*values.values())]
    with unreadable_refused(path), _plot_errors_refused(path):
        cells = select(data, wanted)
    cuts = [cell.cut for cell, _ in cells]
    taken = {dim: ",".join(dict.fromkeys(cut[dim] for cut in cuts)) for dim in cuts[0]}
    target = out or _named(path, "history", *_cut(taken))
    _warn_of_nearest(path, values, cuts)
    _refuse_existing(target, force)
    runner.configure(int(store.dtype.removeprefix("float")), "cpu")
    motions = [History(cell, simulate(store.grid, index, store.dtype)) for cell, index in cells]
    _save(draw(motions), target, data)
    _say_where(values, cuts[0])


def export(
    path: StorePath,
    to: Annotated[Format, typer.Option(help="format to write")],
    out: NewFile = None,
    force: Force = False,
) -> None:
    """Write a store as one table or one NetCDF file."""
    from sweeps.cli.messages import counted
    from sweeps.export import SUFFIX, files, write
    from sweeps.spec.mistakes import command
    from sweeps.store.format import DIVERGED, NOT_RUN, OK
    from sweeps.store.opening import dataset, open_store

    target = out or Path(_store_name(path) + SUFFIX[to.value])
    for file in files(target, to.value):
        _refuse_existing(file, force)
    data = dataset(path)
    with unreadable_refused(path):
        try:
            rows = write(data, target, to.value)
        except OSError as error:
            complain(f"{error.filename}: {error.strerror}")
            if to is Format.netcdf:
                os._exit(1)  # HDF5 could not close its file, and would crash now
            raise typer.Exit(1) from None
    names = " and ".join(map(str, files(target, to.value)))
    store = open_store(path)
    grid = store.grid
    noun = "cell" if grid.sweep.reduce or grid.sweep.refine else "scenario"
    ran = int(data["status"].isin([OK, DIVERGED]).sum())
    simulated = f", {ran:,} of them simulated" if grid.sweep.refine else ""
    print(f"wrote {names}, {counted(rows, noun)}{simulated}{_old_definition(data)}")
    others = grid.cells - grid.own_cells
    left = int((data["status"] == NOT_RUN).sum()) - others
    if others:
        complain(f"warning: {others:,} of them are of other shards than {grid.shard}")
    if left:
        complain(f"warning: {left:,} of them were not run; {command('resume', path)} runs them")


def share(
    path: StorePath,
    metric: Annotated[
        list[str] | None,
        typer.Option(help="may be repeated: what the file has, the first shown; default: all"),
    ] = None,
    pin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE,...",
            help="may be repeated: a cell whose motion is drawn; default: best, median, worst",
        ),
    ] = None,
    x: Annotated[str | None, typer.Option(help="horizontal axis of the first map")] = None,
    y: Annotated[str | None, typer.Option(help="its vertical axis")] = None,
    out: NewFile = None,
    size: Annotated[float, typer.Option(metavar="MB", help="most megabytes of the file")] = 10.0,
    force: Force = False,
) -> None:
    """Write a store as one HTML file for mailing: maps with sliders, and the motions of cells."""
    for module in ("bokeh", "llvmlite"):
        if importlib.util.find_spec(module) is None:
            refuse(f"share needs {module}: `pip install 'fic-jax[explore]'`")
    target = out or Path(_store_name(path) + ".html")
    _refuse_existing(target, force)
    check_matplotlib()
    from datetime import UTC, datetime

    from sweeps import runner
    from sweeps.cli.messages import counted, record
    from sweeps.explore.stored import Stored
    from sweeps.share.coarse import copied
    from sweeps.share.page import check_size, page, room_for_copy
    from sweeps.share.pins import choose, simulated
    from sweeps.spec.mistakes import command

    most = room_for_copy(size)
    with unreadable_refused(path):
        source = Stored(path)
        if source.grid.sweep.refine:
            axes = zip(("--x", "--y"), source.grid.dims, strict=False)
            draw = command("plot", path, *(word for axis in axes for word in axis))
            refuse(f"{path}: is refined, and a page has no boxes; {draw} draws them")
        named = _pinned(path, source, pin)
        metrics = _shared_metrics(path, source, metric)
        view = _first_map(path, source, metrics[0], x, y)
        copy = copied(source, metrics, [index for _, index in named], most)
    if source.has_motion:
        runner.configure(int(source.dtype.removeprefix("float")), "cpu")
        pins = simulated(source, named or choose(copy, view))
    else:
        pins = []
    now = datetime.now(UTC)
    content = check_size(page(source, copy, pins, view, record(source.store), now), size)
    _replace(target, content)
    cells = counted(copy.cells, "cell")
    print(f"wrote {target}, {len(content) / 1e6:.2g} MB, {cells} of {source.grid.cells:,}")


def check_matplotlib() -> None:
    """Refuse settings of matplotlib that keep it from being imported; all others are ignored."""
    # it would print lines about settings that no picture of ours has
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        import matplotlib  # noqa: F401
    except ValueError as error:
        where = "a matplotlibrc in this folder, in $MATPLOTLIBRC or in its own folder"
        refuse(f"matplotlib can't read its settings, {where}: {error}")


def _refuse_existing(target: Path | None, force: bool) -> None:
    """Refuse a file that exists, what is no file, and all that lies in a store."""
    if target is None:
        return
    from sweeps.store.place import store_around

    if outer := store_around(target):
        refuse(f"{target}: lies in the store {outer}; --out names another place")
    if not os.path.lexists(target):
        return
    if not target.is_file() and not target.is_symlink():
        refuse(f"{target}: is no regular file; --out names another")
    if not force:
        refuse(f"{target}: exists already; --force replaces it, --out names another")


def _pinned(
    path: Path, source: "Stored", texts: list[str] | None
) -> list[tuple[str, tuple[int, ...]]]:
    """The cells that `--pin` names, each once, with their indices in the store."""
    from figures.history import select
    from sweeps.share.pins import MOST_PINS
    from sweeps.store.opening import dataset

    if texts and not source.has_motion:
        refuse(f"{path}: is reduced, and a cell of it has no motion to pin")
    found: dict[tuple[int, ...], str] = {}
    for text in texts or ():
        values = _values([text], None, "--pin")
        with _plot_errors_refused(path):
            ((cell, index),) = select(dataset(path), [_single(values, "--pin")])
        _warn_of_nearest(path, values, [cell.cut])
        found.setdefault(index, f"pin {len(found) + 1}")
    if len(found) > MOST_PINS:
        refuse(f"--pin: {len(found)} cells are too many to tell apart: name up to {MOST_PINS}")
    return [(name, index) for index, name in found.items()]


def _shared_metrics(path: Path, source: "Stored", names: list[str] | None) -> list[str]:
    """The metrics of a page, the one shown first: all but error estimates by default."""
    from figures.cut import require_metric
    from sweeps.store.format import ERRORS
    from sweeps.store.opening import dataset

    with _plot_errors_refused(path):
        for name in names or ():
            require_metric(name, dataset(path))
    first = source.start.metric
    metrics = [first, *(name for name in source.space.metrics if name not in ERRORS)]
    return list(dict.fromkeys(names or metrics))


def _first_map(path: Path, source: "Stored", metric: str, x: str | None, y: str | None) -> "View":
    """What a page shows first."""
    from dataclasses import replace

    from figures.cut import require_dimension
    from sweeps.store.opening import dataset

    view = replace(source.start, metric=metric)
    with _plot_errors_refused(path):
        for side, name in (("x", x), ("y", y)):
            if name is not None:
                require_dimension(name, dataset(path), metric)
                view = source.with_axis(view, side, name)
    if x is not None and x == y:
        refuse(f"--x {x} --y {y}: must be two dimensions")
    return view


def _replace(target: Path, content: bytes) -> None:
    """Write a file, which has its name once it is whole."""
    target = Path(os.path.realpath(target))  # a link stays a link
    partial = target.with_name(f".{target.name}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(target)
    except OSError as error:
        reason = f"{target}: can't be written: {error.strerror}"
        fail(reason) if disk.refused(error) else refuse(reason)
    finally:
        partial.unlink(missing_ok=True)


def _store_name(path: Path) -> str:
    return Path(os.path.abspath(path)).name.removesuffix(".zarr")


def _named(path: Path, *parts: str) -> Path:
    """The default name of a picture: the store, then what is drawn of it."""
    return Path("-".join([_store_name(path), *parts]) + ".png")


def _cut(values: Mapping[str, str]) -> list[str]:
    return [f"{dim}={value}" for dim, value in values.items()]


def _save(figure: "Figure", target: Path, data: "xr.Dataset") -> None:
    from figures import save

    try:
        save(figure, target)
    except OSError as error:
        if disk.refused(error):
            fail(f"{target}: can't be written: {error.strerror}")
        refuse(f"{target}: can't be written: {error.strerror or error}")
    except ValueError as error:
        refuse(f"{target}: can't be written: {error}")
    print(f"wrote {target}{_old_definition(data)}")


@contextmanager
def _plot_errors_refused(path: Path) -> Iterator[None]:
    from figures import PlotError

    try:
        yield
    except PlotError as error:
        refuse(f"{path}: {error}")


def _warn_of_nearest(
    path: Path, wanted: Mapping[str, list[str]], cuts: Sequence[Mapping[str, str]]
) -> None:
    """Warn of each value that was not run."""
    for dim, given in wanted.items():
        taken = [cut[dim] for cut in cuts]
        for value in given:
            if not any(_same(value, one) for one in taken):
                nearest = min(taken, key=lambda one: abs(float(one) - float(value)))
                complain(f"warning: {path} has no {dim} = {value}; drawn is the nearest, {nearest}")


def _say_where(wanted: Mapping[str, list[str]], cut: Mapping[str, str]) -> None:
    """Say where the store was cut without a wish."""
    rest = {dim: value for dim, value in cut.items() if dim not in wanted}
    if rest:
        middle = " ".join(_cut(rest))
        print(f"drawn at --at {middle}, because no --at names another value")


def _same(given: str, taken: str) -> bool:
    """Whether the value of a cell is the given one."""
    try:
        return math.isclose(float(given), float(taken), rel_tol=1e-9)
    except ValueError:
        return given == taken


def _old_definition(data: "xr.Dataset") -> str:
    """What the metrics are, if this program would compute others."""
    from sweeps.store.format import DEFINITION

    old = data.attrs["metrics_definition"] != DEFINITION
    return f"; its metrics are {data.attrs['metrics_definition_meaning']}" if old else ""


def _values(
    at: list[str] | None, more: list[str] | None, option: str = "--at"
) -> dict[str, list[str]]:
    """`--at KEY=VALUE ...`: dimension -> its values; VALUE alone is another one of the last KEY."""
    values: dict[str, list[str]] = {}
    key = ""
    for text in (*(at or ()), *(more or ())):
        for part in text.split(","):
            before, equals, after = (word.strip() for word in part.rpartition("="))
            key = before if equals else key
            if not (key and after) or "=" in key:
                refuse(f"{option} {text}: must be KEY=VALUE, as in {option} Td=5")
            values.setdefault(key, []).append(after)
    return values


def _single(values: Mapping[str, list[str]], option: str = "--at") -> dict[str, str]:
    """One value of each dimension. Refuses a second one: a picture is cut at one place."""
    for key, given in values.items():
        if len(given) > 1:
            both = " and ".join(given)
            several = "another --pin" if option == "--pin" else "`history`"
            refuse(f"{option} {key}: is given twice, {both}; {several} draws several")
    return {key: given[0] for key, given in values.items()}
