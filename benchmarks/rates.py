"""Plant steps per second of each implementation, and cost against the number of scenarios."""

from contextlib import ExitStack

from benchmarks.child import Child, Missing
from benchmarks.implementations import IMPLEMENTATIONS
from benchmarks.plan import Plan, Say
from benchmarks.tables import Row, Table, measured

SCENARIOS = 65_536
FIRST, SECONDS = "benchmarks.implementations.first", "benchmarks.implementations.seconds"
DECADES, DECADES_FULL = (10_000, 100_000, 1_000_000), (10_000, 100_000, 1_000_000, 10_000_000)


def rates(plan: Plan, say: Say) -> Table:
    """The rate of each implementation, and its baseline's rate over it in the same round."""
    wanted = {k: one for k, one in IMPLEMENTATIONS.items() if plan.peers or not one.peer}
    sizes = {k: max((plan.scenarios or SCENARIOS) // one.share, 1) for k, one in wanted.items()}
    compiled: dict[str, float] = {}
    notes = []
    with ExitStack() as stack:
        children: dict[str, Child] = {}
        for kind, one in wanted.items():
            say(f"rates: compiling {one.name}")
            child = stack.enter_context(Child())
            try:
                compiled[kind] = child.call(FIRST, kind=kind, steps=plan.steps, n=sizes[kind])
                children[kind] = child
            except Missing as why:
                notes.append(f"{one.name}: not measured: {why}")
        speeds: dict[str, list[float]] = {kind: [] for kind in children}
        for i in range(plan.repeats):
            say(f"rates: round {i + 1} of {plan.repeats}")
            for kind in children if i % 2 == 0 else reversed(children):  # cancels a drift
                taken = children[kind].call(SECONDS, kind=kind, steps=plan.steps, n=sizes[kind])
                speeds[kind].append(sizes[kind] * plan.steps / taken / 1e6)
    rows = [
        {
            "kind": kind,
            "name": wanted[kind].name,
            "scenarios": sizes[kind],
            "first_s": compiled[kind],
        }
        | _rate(kind, speeds)
        for kind in children
    ]
    return Table(
        f"Rates: default model, float32 and random scenarios unless said otherwise, {plan.steps:,} "
        "steps, all metrics",
        [
            ("", "{name}"),
            ("scenarios", "{scenarios:,}"),
            ("M steps/s, median", "{million_steps_per_s[median]:.1f}"),
            ("best", "{million_steps_per_s[best]:.1f}"),
            ("baseline", "{baseline}"),
            ("baseline / it, median of rounds", "{baseline_over_it[median]:.2f}"),
            ("of the bests", "{baseline_over_it[best]:.2f}"),
            ("target", "{baseline_over_it[target]}"),
            ("met", "{baseline_over_it[met]}"),
        ],
        rows,
        notes,
    )


def _rate(kind: str, speeds: dict[str, list[float]]) -> Row:
    """The rate of one implementation, and its baseline's rate over it unless it is the engine."""
    row: Row = {"million_steps_per_s": measured(speeds[kind], max)}
    if kind != "engine":
        one = IMPLEMENTATIONS[kind]
        base = speeds[one.baseline]
        ratios = [a / b for a, b in zip(base, speeds[kind], strict=True)]
        ratio = measured(ratios, at_least=one.at_least, at_most=one.at_most)
        row["baseline"] = IMPLEMENTATIONS[one.baseline].name
        row["baseline_over_it"] = ratio | {"best": max(base) / max(speeds[kind])}
    return row


def scaling(plan: Plan, say: Say) -> Table:
    """Microseconds per scenario against their number, on all devices and on one."""
    sizes = list(DECADES_FULL if plan.full else DECADES)
    if plan.scenarios:
        sizes = sorted({max(plan.scenarios // part, 1) for part in (100, 10, 1)})
    rows = []
    with Child() as every, Child() as one:
        every.call(FIRST, kind="engine", steps=plan.steps, n=sizes[0])
        one.call(FIRST, kind="engine", steps=plan.steps, n=sizes[0], devices=1)
        for n in sizes:
            say(f"scaling: {n:,} scenarios")
            arguments = {"kind": "engine", "steps": plan.steps, "n": n}
            pairs = [
                [1e6 / n * child.call(SECONDS, **arguments) for child in (every, one)]
                for _ in range(plan.rounds(n))
            ]
            all_us, one_us = zip(*pairs, strict=True)
            rows.append(
                {
                    "scenarios": n,
                    "all_us": measured(list(all_us)),
                    "one_us": measured(list(one_us)),
                    "one_over_all": measured([b / a for a, b in pairs], max),
                }
            )
    return Table(
        f"Cost of a scenario of {plan.steps:,} steps, in microseconds",
        [
            ("scenarios", "{scenarios:,}"),
            ("all devices, median", "{all_us[median]:.2f}"),
            ("best", "{all_us[best]:.2f}"),
            ("one device, median", "{one_us[median]:.2f}"),
            ("best", "{one_us[best]:.2f}"),
            ("one / all", "{one_over_all[median]:.2f}"),
        ],
        rows,
    )
