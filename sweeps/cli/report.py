"""`report`: the paper's claims beside simulations."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sweeps import LIBRARY
from sweeps.cli import interruption
from sweeps.cli.errors import fail

if TYPE_CHECKING:
    from sweeps.paper.compose import Surroundings
    from sweeps.runner import Progress


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
    """Compare the paper's claims with simulations. Writes report.md and .html, in some minutes."""
    stop = interruption.stop_on_signals()
    from sweeps import runner
    from sweeps.paper import compose
    from sweeps.paper.claims import chosen

    claims = chosen(only or [])
    runner.configure(64)
    given = _surroundings(stop)
    if only:
        for line in compose.lines(compose.judged(claims, given)):
            print(line)
        return
    try:
        page = compose.compose(results, given)
    except (KeyboardInterrupt, OSError) as error:
        why = "interrupted" if isinstance(error, KeyboardInterrupt) else f"failed: {error}"
        fail(f"{why}; the stores in {results} are kept, the same command does the rest")
    print(f"wrote {results / 'report.md'} and {results / 'report.html'}")
    if docs:
        print(f"wrote {compose.copy(page, results, docs)}")


def _surroundings(stop: interruption.Stop) -> "Surroundings":
    """What a report takes from the command line: the library, the pictures, lines and stops."""
    from figures.report import draw
    from sweeps.paper.compose import Surroundings

    def after_block(name: str, progress: "Progress") -> None:
        if progress.done == progress.cells:
            print(f"{name}: {progress.cells:,} scenarios", flush=True)
        stop.after_block(progress)

    return Surroundings(
        LIBRARY, lambda line: print(line, flush=True), after_block, stop.raise_if_requested, draw
    )
