"""The most memory that a sweep takes on the card, with and without located switches.

Each case has a fresh process, while no other one of ours is on the card. NVML is read every few
milliseconds during its calls; what the card had in use before is taken off.
"""

from time import sleep
from typing import Any

from benchmarks.child import BenchError, Child, Missing
from benchmarks.gpu.card import memory_used
from benchmarks.gpu.results import missing
from benchmarks.gpu.session import LeftOut, Session
from benchmarks.gpu.speed import Contender, prepared
from benchmarks.tables import Row, Table

CALLS = 3
IDLE = 1.0  # s in which the memory before is read; the card frees that of an ended process late


def measure(session: Session) -> None:
    """Record the memory of the first backend at each size."""
    plan = session.plan
    backend, dtype = plan.backends[0], plan.dtypes[0]
    for located in (integrator == "rk4_events" for integrator in plan.integrators):
        one = Contender(
            f"{backend}, located" if located else backend, dtype, backend, None, located
        )
        for n in plan.sizes:
            case = f"{one.name}, {dtype}, {n:,}"
            session.say(f"memory: {case}")
            try:
                with memory_used() as before:
                    sleep(IDLE)
                arguments: dict[str, Any] = {**vars(one), "n": n, "steps": plan.run_steps}
                with memory_used() as during, Child() as child:
                    session.ask(child, "benchmarks.gpu.memory.calls", **arguments)
            except (BenchError, Missing, LeftOut) as why:
                session.failed("memory", case, why)
                continue
            about: Row = {"name": one.name, "dtype": dtype, "scenarios": n}
            peak = (max(during) - min(before)) / 1e6
            session.results.add("memory", case, None, **about, steps=plan.run_steps, peak_MB=peak)


def calls(**arguments: Any) -> None:
    """Call the contender a few times (in a child)."""
    n, steps = arguments.pop("n"), arguments.pop("steps")
    whole, _ = prepared(Contender(**arguments), n, "random", steps, resident=False)
    for _ in range(CALLS):
        whole()


def tables(records: list[Row]) -> list[Table]:
    """A row for each size."""
    rows = [r for r in records if "why" not in r]
    table = Table(
        "Memory: the most that a sweep takes on the card, with its context",
        [
            ("", "{name}"),
            ("dtype", "{dtype}"),
            ("scenarios", "{scenarios:,}"),
            ("peak, MB", "{peak_MB:,.0f}"),
        ],
        rows,
        missing(records),
    )
    return [table] if records else []
