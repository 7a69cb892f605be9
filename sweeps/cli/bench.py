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


def bench(
    scenarios: Annotated[
        int | None, typer.Option(min=1, help="of the largest runs, not each table's own")
    ] = None,
    steps: Annotated[int, typer.Option(min=2, help="plant steps of a scenario")] = 1_000,
    repeats: Annotated[int, typer.Option(min=1, help="rounds; fewer where a call is long")] = 5,
    only: Annotated[list[Table] | None, typer.Option(help="this table; repeatable")] = None,
    full: Annotated[bool, typer.Option("--full", help="larger sweeps too, some minutes")] = False,
    json: Annotated[bool, typer.Option("--json", help="for machines")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="for a README")] = False,
) -> None:
    """Measure this machine: the engine, its peers, whole runs. Takes two or three minutes."""
    if json and markdown:
        refuse("--json and --markdown: one of them")
    from json import dumps

    from sweeps.bench.plan import Plan
    from sweeps.bench.processes import BenchError
    from sweeps.bench.tables import measure
    from sweeps.bench.text import as_markdown, as_text

    plan = Plan(scenarios, steps, repeats, full, tuple(table.value for table in only or []))
    raise_on_signals()
    try:
        result = measure(plan, lambda line: print(line, file=sys.stderr, flush=True))
    except (BenchError, KeyboardInterrupt) as error:
        fail(str(error) or "interrupted")
    print(dumps(result) if json else (as_markdown if markdown else as_text)(result))
