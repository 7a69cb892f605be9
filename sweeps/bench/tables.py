"""Measure this machine: every table that is asked for, after one another."""

from collections.abc import Callable
from dataclasses import asdict

from sweeps.bench.commands import first, run
from sweeps.bench.machine import machine, versions
from sweeps.bench.plan import Plan, Table, Tell
from sweeps.bench.rates import rates, scaling

TABLES: dict[str, Callable[[Plan, Tell], Table]] = {
    "rates": rates,
    "scaling": scaling,
    "run": run,
    "first": first,
}


def measure(plan: Plan, tell: Tell) -> Table:
    """The machine, the versions and the tables. Raises BenchError if one can't be taken."""
    where = machine()  # first: its load is the load before ours
    wanted = [name for name in TABLES if name in (plan.only or TABLES)]
    return {
        "machine": where,
        "versions": versions(),
        "settings": asdict(plan),
        "tables": {name: TABLES[name](plan, tell) for name in wanted},
    }
