"""`fic-sweep`: the command line, and the only file that prints.

Heavy imports stay inside the commands, so that `--help` answers at once.
"""

import atexit
import gc
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from sweeps.runner import Progress
    from sweeps.spec.types import Sweep
    from sweeps.store.opening import Store

app = typer.Typer(
    name="fic-sweep",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

LIBRARY = Path(__file__).parent.parent / "library"


class Precision(StrEnum):
    """Bits of a number."""

    single = "32"
    double = "64"


class Device(StrEnum):
    """Where a sweep runs."""

    cpu = "cpu"
    gpu = "gpu"


class Format(StrEnum):
    """What `export` writes."""

    csv = "csv"
    parquet = "parquet"
    netcdf = "netcdf"


class BenchTable(StrEnum):
    """What `bench` measures."""

    rates = "rates"
    scaling = "scaling"
    run = "run"
    first = "first"
    commit = "commit"


What = Annotated[str, typer.Argument(metavar="NAME|FILE", help="library name or TOML file")]
Where = Annotated[Path, typer.Argument(metavar="PATH", help="a result store")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="change a value; a list or range is an axis"),
]


@contextmanager
def importing() -> Iterator[None]:
    """Import for a sweep without what takes a fifth of a second and does nothing for it."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy would start a thread for each core
    gc.disable()  # what is imported stays: there is nothing to collect, and much to look at
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@app.command("list")
def list_() -> None:
    """Name the sweeps of the library."""
    from sweeps.plan.grid import Grid
    from sweeps.spec.reading import load

    for path in sorted(LIBRARY.glob("*.toml")):
        sweep = load(path)
        print(f"{sweep.name:16} {Grid(sweep).cells:>12,}  {sweep.description}")


@app.command()
def show(what: What) -> None:
    """Print a sweep file and what it comes to."""
    from sweeps.cli.messages import plan_lines
    from sweeps.plan.grid import Grid

    sweep = _load(what, None)
    print(_find(what).read_text(encoding="utf-8").rstrip())
    print()
    for line in plan_lines(Grid(sweep), "float32"):
        print(f"# {line}")
    _warn(sweep)


@app.command()
def run(
    what: What,
    out: Annotated[Path | None, typer.Option(metavar="PATH", help="the store to make")] = None,
    set_: Set = None,
    dry_run: Annotated[bool, typer.Option(help="size, bytes and expected time only")] = False,
    precision: Annotated[Precision, typer.Option(help="bits of a number")] = Precision.single,
    chunk: Annotated[int | None, typer.Option(min=1, help="cells of a block at most")] = None,
    device: Annotated[Device | None, typer.Option(help="default: a GPU if JAX has one")] = None,
    error_estimate: Annotated[
        bool, typer.Option("--error-estimate", help="also store the error of every metric")
    ] = False,
) -> None:
    """Run a sweep into a new store."""
    asked = _stop_between_blocks()
    set_ = [*(set_ or []), *(["error_estimate=true"] if error_estimate else [])]
    with importing():
        sweep = _load(what, set_)
        from sweeps import runner

    runner.configure(int(precision), device and device.value)
    _warn(sweep)
    if dry_run:
        _dry_run(sweep, chunk, f"float{precision}")
        return
    store = runner.start(out or Path(f"{sweep.name}.zarr"), sweep, chunk, int(precision))
    _carry_out(store, asked)


@app.command()
def resume(
    path: Where,
    extend: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="a larger sweep; what is there is kept")
    ] = None,
) -> None:
    """Run the blocks of a store that are not done yet."""
    asked = _stop_between_blocks()
    with importing():
        sweep = _load(extend, None) if extend else None
        from sweeps.store import extend as extension

    with _kept(path):
        extension.recover(path)
        store = _reopened(path)
        if extend and sweep:
            _warn(sweep)
            store = extension.extend(store, sweep, str(_find(extend)))
    _carry_out(store, asked)


@app.command()
def verify(
    path: Where,
    repair: Annotated[bool, typer.Option("--repair", help="compute again what is bad")] = False,
) -> None:
    """Compare every file of a store with its ledger."""
    from sweeps.cli.messages import interruption, many, verification
    from sweeps.store import verify as check

    def look() -> check.Report:
        report = check.verify(path)
        print("\n".join(verification(path, report)), flush=True)
        return report

    with _kept(path):
        report = look()
        if repair and report.frame:
            check.mend_frame(path)
            report = look()
        blocks = report.bad_blocks
        if repair and blocks:
            print(f"{path}: computing {many(len(blocks), 'block')} again", flush=True)
            asked, store = _stop_between_blocks(), _reopened(path)
            try:
                other = check.recompute(store, blocks, lambda told: _stop_if(asked, told))
            except KeyboardInterrupt as error:
                print(f"fic-sweep: {interruption(store, error)}", file=sys.stderr)
                raise typer.Exit(1) from None
            for block in other:
                print(f"fic-sweep: {path}: block {block} came out different", file=sys.stderr)
            report = look()
    raise typer.Exit(1 if report.problems else 0)


@contextmanager
def _kept(path: Path) -> Iterator[None]:
    """What the system refuses while a store is changed or looked at: one line, and exit 1."""
    from sweeps.cli.messages import refusal

    try:
        yield
    except OSError as error:
        print(f"fic-sweep: {refusal(path, error)}", file=sys.stderr)
        raise typer.Exit(1) from None


def _reopened(path: Path) -> "Store":
    """A store to be gone on with, JAX being set up for its precision."""
    from sweeps import runner
    from sweeps.store.opening import open_store

    store = open_store(path)
    precision = int(store.dtype.removeprefix("float"))
    runner.configure(precision, str(store.group.attrs.get("platform", "cpu")))
    return runner.reopen(path, precision)


@app.command()
def status(path: Where) -> None:
    """Tell how far a store is and what made it."""
    from sweeps.cli.messages import status_lines
    from sweeps.store.opening import open_store

    with _reading(path):
        lines = status_lines(open_store(path))
    for line in lines:
        print(line)


@app.command()
def plot(
    path: Where,
    x: Annotated[str, typer.Option(help="dimension drawn to the right")],
    y: Annotated[str, typer.Option(help="dimension drawn upwards")],
    metric: Annotated[str, typer.Option(help="what the colour shows")] = "nmse",
    at: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="where the rest is cut")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="the picture to write")] = None,
) -> None:
    """Draw a heatmap of a metric over two dimensions."""
    from figures import PlotError, save
    from figures import plot as draw
    from sweeps.store.opening import dataset

    data, fixed = dataset(path), {}
    for key, value in (_pair(text, "--at") for text in at or []):
        if key in fixed:
            _refuse(f"--at {key}={value}: {key} is given twice")
        fixed[key] = value
    with _reading(path):
        try:
            figure = draw(data, x=x, y=y, metric=metric, at=fixed)
        except PlotError as error:
            _refuse(f"{path}: {error}")
    target = out or Path(f"{data.attrs['name']}-{metric}.png")
    try:
        save(figure, target)
    except (OSError, ValueError) as error:
        _refuse(f"{target}: can't be written: {error}")
    print(f"wrote {target}")


@app.command()
def export(
    path: Where,
    to: Annotated[Format, typer.Option(help="what to write")],
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="the file to make")] = None,
) -> None:
    """Write a store as one table or one NetCDF file."""
    from sweeps.export import SUFFIX, write
    from sweeps.store.opening import dataset

    data = dataset(path)
    target = out or Path(f"{data.attrs['name']}{SUFFIX[to.value]}")
    with _reading(path):
        rows = write(data, target, to.value)
    print(f"wrote {target}, {rows:,} scenarios")


@app.command()
def bench(
    scenarios: Annotated[
        int | None, typer.Option(min=1, help="of the largest runs, not each table's own")
    ] = None,
    steps: Annotated[int, typer.Option(min=2, help="plant steps of a scenario")] = 1_000,
    repeats: Annotated[int, typer.Option(min=1, help="rounds; fewer where a call is long")] = 5,
    only: Annotated[list[BenchTable] | None, typer.Option(help="this table; repeatable")] = None,
    full: Annotated[bool, typer.Option("--full", help="larger sweeps too, some minutes")] = False,
    peers: Annotated[
        bool, typer.Option("--peers", help="also C++, numba, diffrax and plain JAX")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="for machines")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="for a README")] = False,
) -> None:
    """Measure this machine: the engine, its cost, whole runs. Takes two or three minutes."""
    if json and markdown:
        _refuse("--json and --markdown: one of them")
    from benchmarks.child import BenchError
    from benchmarks.measure import measure
    from benchmarks.plan import Plan

    plan = Plan(scenarios, steps, repeats, full, peers, tuple(table.value for table in only or []))
    form = "json" if json else "markdown" if markdown else "text"
    for signum in (signal.SIGINT, signal.SIGTERM):  # so that temporary files are removed
        signal.signal(signum, signal.default_int_handler)
    try:
        print(measure(plan, form, lambda line: print(line, file=sys.stderr, flush=True)))
    except (BenchError, KeyboardInterrupt) as error:
        print(f"fic-sweep: {str(error) or 'interrupted'}", file=sys.stderr)
        raise typer.Exit(1) from None


@app.command()
def report(
    results: Annotated[
        Path, typer.Option(metavar="PATH", help="folder of the stores, pictures and pages")
    ] = Path("results"),
    docs: Annotated[
        Path | None, typer.Option(metavar="PATH", help="a folder that gets a copy as report.md")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="ID", help="print these claims alone, as C12")
    ] = None,
) -> None:
    """Hold the paper's claims against simulations: report.md and report.html, in some minutes."""
    asked = _stop_between_blocks()
    from figures.report import draw
    from sweeps import runner
    from sweeps.paper import report
    from sweeps.paper.claims import chosen

    def say(line: str) -> None:
        print(line, flush=True)
        if asked:
            raise KeyboardInterrupt

    def running(name: str, progress: "Progress") -> None:
        if progress.done == progress.cells:
            print(f"{name}: {progress.cells:,} scenarios", flush=True)
        _stop_if(asked, progress)

    claims = chosen(only or [])
    runner.configure(64)
    if only:
        for section in report.sections(claims, say):
            print(f"\n{section.heading}\n\n{section.text}")
        return
    try:
        pages = report.make(results, say, running, draw, docs=docs)
    except (KeyboardInterrupt, OSError) as error:
        why = "interrupted" if isinstance(error, KeyboardInterrupt) else f"failed: {error}"
        rest = f"the stores in {results} are kept, the same command does the rest"
        print(f"fic-sweep: {why}; {rest}", file=sys.stderr)
        raise typer.Exit(1) from None
    for page in pages:
        print(f"wrote {page}")


def _version(asked: bool) -> None:
    if asked:
        from fic_jax import __version__

        print(f"fic-sweep {__version__}")
        raise typer.Exit(0)


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print it and exit")
    ] = False,
) -> None:
    """Sweep the Fractal Impedance Controller over any of its parameters."""


def _find(what: str) -> Path:
    """A library sweep by name, or a file. A name never hides a file that is there."""
    from sweeps.spec.types import suggest

    if Path(what).is_file() or "/" in what or what.endswith(".toml"):
        return Path(what)
    path = LIBRARY / f"{what}.toml"
    if not path.is_file():
        names = sorted(p.stem for p in LIBRARY.glob("*.toml"))
        hint = suggest(what, names) or f"; there are {', '.join(names)}"
        _refuse(f"{what}: is no file and no sweep of the library{hint}")
    return path


def _load(what: str, set_: list[str] | None) -> "Sweep":
    from sweeps.spec.reading import load

    return load(_find(what), tuple(set_ or ()))


def _warn(sweep: "Sweep") -> None:
    from sweeps.runner import warnings_of

    for line in warnings_of(sweep):
        print(f"fic-sweep: warning: {sweep.name}: {line}", file=sys.stderr)


def _dry_run(sweep: "Sweep", chunk: int | None, dtype: str) -> None:
    from sweeps.cli.messages import expectation, plan_lines
    from sweeps.plan.grid import Grid
    from sweeps.runner import measure

    grid = Grid(sweep, chunk)
    for line in plan_lines(grid, dtype):
        print(line)
    print(expectation(grid, *measure(grid, dtype)))


def _stop_between_blocks() -> list[int]:
    """Catch Ctrl-C and SIGTERM: the first asks for a stop, the second stops at once.

    An exception raised in the middle of XLA's compiler crashes the process. Returns the list
    that the signals asked for are put into.
    """
    asked: list[int] = []

    def ask(signum: int, _frame: object) -> None:
        if asked:
            os._exit(1)  # whatever is committed is on disk
        asked.append(signum)
        os.write(2, b"fic-sweep: stopping after the block in hand, once more to stop at once\n")

    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, ask)
    return asked


def _carry_out(store: "Store", asked: list[int]) -> None:
    """Run a store to its end, with progress; whatever happens, finished blocks stay."""
    from sweeps.cli.messages import failure, interruption, summary
    from sweeps.runner import run
    from sweeps.store.opening import Tally

    try:
        result = (_with_bar if sys.stdout.isatty() else _with_lines)(store, asked)
    except (KeyboardInterrupt, OSError) as error:
        if isinstance(error, OSError) or Tally.of(store).pending:
            print(f"fic-sweep: {interruption(store, error)}", file=sys.stderr)
            raise typer.Exit(1) from None
        result = run(store, lambda _: None)  # the block in hand was the last: only its end is left
    with _kept(store.path):
        print(summary(store, result))
    if result.set_aside:
        for line in failure(store, result):
            print(f"fic-sweep: {line}", file=sys.stderr)
        raise typer.Exit(1)


def _with_bar(store: "Store", asked: list[int]) -> "Progress":
    """For a terminal: a bar with rate and time left."""
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    from sweeps import runner
    from sweeps.cli.messages import progress_line

    text = TextColumn("{task.percentage:>3.0f} % {task.fields[told]}")
    with Bar(TextColumn(store.grid.sweep.name), BarColumn(), text, transient=True) as bar:
        task = bar.add_task("", total=store.grid.cells, told="compiling")

        def tell(progress: "Progress") -> None:
            bar.update(task, completed=progress.done, told=progress_line(progress))
            _stop_if(asked, progress)

        return runner.run(store, tell)


def _with_lines(store: "Store", asked: list[int]) -> "Progress":
    """For a log: one line now and then."""
    from sweeps import runner
    from sweeps.cli.messages import log_line

    every, last = 10.0, time.monotonic()  # s

    def tell(progress: "Progress") -> None:
        nonlocal last
        if progress.ran and time.monotonic() - last >= every:
            last = time.monotonic()
            print(log_line(progress), flush=True)
        _stop_if(asked, progress)

    return runner.run(store, tell)


def _stop_if(asked: list[int], progress: "Progress") -> None:
    if asked and progress.done < progress.cells:
        raise KeyboardInterrupt


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """A store that is there but damaged is told in one line, not with zarr's traceback."""
    try:
        yield
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        if isinstance(error, typer.Exit):
            raise
        if isinstance(error, OSError) and error.filename:
            _refuse(f"{path}: can't be read: {error.filename}: {error.strerror}")
        _refuse(f"{path}: can't be read: {str(error).splitlines()[0][:200]}")


def _pair(text: str, option: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        _refuse(f"{option} {text}: must be KEY=VALUE, as in {option} Td=5")
    return key.strip(), value.strip()


def _refuse(message: str) -> NoReturn:
    """The request was wrong: say so and stop."""
    for line in message.splitlines():
        print(f"fic-sweep: {line}", file=sys.stderr)
    raise typer.Exit(2)


def main() -> None:
    """Entry point: exit 0 done, 1 failed or interrupted, 2 the request was wrong."""
    import warnings

    warnings.showwarning = lambda message, *_, **__: print(
        f"fic-sweep: warning: {message}", file=sys.stderr
    )
    code = 1  # of a traceback, or of printing that failed

    def end() -> None:
        with suppress(OSError, ValueError):
            sys.stdout.flush()
        os._exit(code)

    # The first to be registered is the last to be called. What it leaves out, taking apart all that
    # was imported, takes a quarter of a second.
    atexit.register(end)
    try:
        ended = _dispatch()
        sys.stdout.flush()
        code = ended
    except BrokenPipeError:  # `fic-sweep list | head`
        sys.stderr.close()
    sys.exit(code)


def _dispatch() -> int:
    try:
        code = typer.main.get_command(app)(standalone_mode=False) or 0
        return 1 if code == 130 else code  # typer's word for Ctrl-C
    except typer.Exit as stop:
        return stop.exit_code
    except (KeyboardInterrupt, typer.Abort):
        print("fic-sweep: interrupted", file=sys.stderr)
        return 1
    except Exception as error:
        message = _message_of(error)
        if message is None:
            raise
        for line in message.splitlines():
            print(f"fic-sweep: {line}", file=sys.stderr)
        return 2


def _message_of(error: Exception) -> str | None:
    """The line for a wrong request; None for our own mistakes, which keep their traceback."""
    if hasattr(error, "format_message"):  # a wrong option, as the parser of typer tells it
        return " ".join(str(error.format_message()).split())
    from sweeps.spec.types import SweepError

    if isinstance(error, OSError) and error.filename:  # a name too long, a folder not ours
        return f"{error.filename}: {error.strerror}"
    return str(error) if isinstance(error, SweepError) else None
