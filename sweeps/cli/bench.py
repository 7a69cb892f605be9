"""`bench`: how fast this machine is."""

import sys
from enum import StrEnum
from typing import Annotated

import typer

from sweeps.cli.errors import fail, refuse
from sweeps.cli.interruption import raise_on_signals


class Table(StrEnum):
    """What `bench` measures."""

    rates = "rates"
    scaling = "scaling"
    run = "run"
    first = "first"
    commit = "commit"


def bench(
    scenarios: Annotated[
        int | None, typer.Option(min=1, help="of the largest runs, not each table's own")
    ] = None,
    steps: Annotated[int, typer.Option(min=2, help="plant steps of a scenario")] = 1_000,
    repeats: Annotated[int, typer.Option(min=1, help="rounds; fewer where a call is long")] = 5,
    only: Annotated[list[Table] | None, typer.Option(help="this table; repeatable")] = None,
    full: Annotated[bool, typer.Option("--full", help="larger sweeps too, some minutes")] = False,
    peers: Annotated[
        bool, typer.Option("--peers", help="also C++, numba, diffrax and plain JAX")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="for machines")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="for a README")] = False,
) -> None:
    """Measure this machine: the engine, its cost, whole runs. Takes two or three minutes."""
    if json and markdown:
        refuse("--json and --markdown: one of them")
    from benchmarks.child import BenchError
    from benchmarks.measure import measure
    from benchmarks.plan import Plan

    plan = Plan(scenarios, steps, repeats, full, peers, tuple(table.value for table in only or []))
    form = "json" if json else "markdown" if markdown else "text"
    raise_on_signals()
    try:
        print(measure(plan, form, lambda line: print(line, file=sys.stderr, flush=True)))
    except (BenchError, KeyboardInterrupt) as error:
        fail(str(error) or "interrupted")
