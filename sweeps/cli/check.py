"""`status` and `verify`: how far a store is, and whether its files are as they were written."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sweeps.cli import interruption
from sweeps.cli.arguments import StorePath
from sweeps.cli.errors import complain, fail, system_errors_reported, unreadable_refused
from sweeps.cli.run import reopen

if TYPE_CHECKING:
    from sweeps.store.verify import Report


def status(path: StorePath) -> None:
    """Print how far a store is and which program made it."""
    from sweeps.cli.messages import status_lines
    from sweeps.store.opening import open_store

    with unreadable_refused(path):
        store = open_store(path)
        store.check_done()
        lines = status_lines(store)
    for line in lines:
        print(line)


def verify(
    path: StorePath,
    repair: Annotated[
        bool, typer.Option("--repair", help="restore metadata, compute damaged blocks again")
    ] = False,
) -> None:
    """Compare every file of a store with its ledger."""
    from sweeps.spec.mistakes import command
    from sweeps.store.verify import repair_metadata

    different: list[int] = []
    with system_errors_reported(path):
        report = _check(path)
        if repair and report.metadata:
            repair_metadata(path)
            report = _check(path)
        if repair and report.bad_blocks:
            different = _recompute(path, report.bad_blocks)
            report = _check(path)
    if not repair and (report.metadata or report.bad_blocks):
        print(f"{path}: {command('verify', path, '--repair')} repairs it")
    raise typer.Exit(1 if report.problems or different else 0)


def _check(path: Path) -> "Report":
    from sweeps.cli.messages import verification
    from sweeps.store.verify import verify as check

    report = check(path)
    print("\n".join(verification(path, report)), flush=True)
    return report


def _recompute(path: Path, blocks: list[int]) -> list[int]:
    """Run blocks again; returns those that came out different, and names them."""
    from sweeps.cli.messages import counted, interrupted
    from sweeps.runner import recompute

    print(f"{path}: computing {counted(len(blocks), 'block')} again", flush=True)
    stop, store = interruption.stop_on_signals(), reopen(path)
    try:
        different = recompute(store, blocks, stop.after_block)
    except KeyboardInterrupt as error:
        fail(interrupted(store, error))
    for block in different:
        complain(f"{path}: block {block} came out different; the store has its new numbers")
    return different
