"""The tables of `fic-sweep bench`, one after the other."""

from collections.abc import Callable
from dataclasses import asdict

from benchmarks.commit import commit
from benchmarks.machine import machine
from benchmarks.plan import Plan, Say
from benchmarks.rates import rates, scaling
from benchmarks.tables import Table, render
from benchmarks.whole_runs import first, run

TABLES: dict[str, Callable[[Plan, Say], Table]] = {
    "rates": rates,
    "scaling": scaling,
    "run": run,
    "first": first,
    "commit": commit,
}


def measure(plan: Plan, form: str, say: Say) -> str:
    """Take the tables and render them. Raises BenchError if one fails."""
    before = machine()  # first, so that its load is not ours
    wanted = [name for name in TABLES if name in (plan.only or TABLES)]
    tables = {name: TABLES[name](plan, say) for name in wanted}
    return render(before, tables, form, **asdict(plan))
