"""`report`: the paper's claims beside simulations."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sweeps.cli import interruption
from sweeps.cli.arguments import folder
from sweeps.cli.errors import fail
from sweeps.cli.output import check_matplotlib

if TYPE_CHECKING:
    from sweeps.runner import Progress


def report(
    results: Annotated[
        Path,
        typer.Option(parser=folder, metavar="PATH", help="folder of the stores, pictures, pages"),
    ] = Path("results"),
    docs: Annotated[
        Path | None,
        typer.Option(parser=folder, metavar="PATH", help="a folder that gets a copy as report.md"),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="ID", help="print these claims alone, as C12,C13")
    ] = None,
) -> None:
    """Compare the paper's claims with simulations. Writes report.md and .html, in some minutes."""
    stop = interruption.stop_on_signals()
    check_matplotlib()
    from figures.report import draw
    from sweeps import runner
    from sweeps.paper import report as paper_report
    from sweeps.paper.claims import chosen

    def say(line: str) -> None:
        print(line, flush=True)
        stop.raise_if_requested()

    def after_block(name: str, progress: "Progress") -> None:
        if progress.done == progress.cells:
            print(f"{name}: {progress.cells:,} scenarios", flush=True)
        stop.after_block(progress)

    names = [name.strip() for text in only or [] for name in text.split(",")]
    claims = chosen([name for name in names if name])
    runner.configure(64)
    if only:
        for section in paper_report.sections(claims, say):
            print(f"\n{section.heading}\n\n{section.text}")
        return
    try:
        pages = paper_report.make(results, say, after_block, draw, docs=docs)
    except (KeyboardInterrupt, OSError) as error:
        why = "interrupted" if isinstance(error, KeyboardInterrupt) else f"failed: {error}"
        fail(f"{why}; the stores in {results} are kept, the same command does the rest")
    for page in pages:
        print(f"wrote {page}")
