"""Tables 1 and 2: the engine against its peers, and its cost against the number of scenarios."""

from contextlib import ExitStack
from dataclasses import dataclass

from sweeps.bench.plan import Plan, Table, Tell, summary, within
from sweeps.bench.processes import BenchError, Child

SCENARIOS = 65_536
DECADES, DECADES_FULL = (10_000, 100_000, 1_000_000), (10_000, 100_000, 1_000_000, 10_000_000)


@dataclass(frozen=True)
class Peer:
    """One arrangement of the first table."""

    kind: str
    name: str
    share: int = 1  # of the scenarios this part: a rate is per scenario, and a slow one takes long
    at_least: float | None = None  # target of the engine's rate over this one's
    at_most: float | None = None


# In the order they are timed: the engine's nearest rival right beside it.
PEERS = (
    Peer("engine", "engine"),
    Peer("cpp", "C++ twin", at_least=0.90),
    Peer("numba", "numba twin", at_least=2.0),
    Peer("float64", "engine, float64", share=2, at_most=1 / 0.45),
    Peer("events", "engine, rk4_events", share=2, at_most=3.0),
    Peer("xla", "engine by XLA alone", share=2),
    Peer("plain", "plain jit(vmap(scan))", share=4, at_least=3.5),
    Peer("diffrax", "diffrax twin", share=8, at_least=8.0),
    Peer("estimate", "engine, error_estimate", share=8),
)


def rates(plan: Plan, tell: Tell) -> Table:
    """Plant steps a second of everyone, and the engine's rate over theirs, round by round."""
    seconds: dict[str, list[float]] = {peer.kind: [] for peer in PEERS}
    with ExitStack() as stack:
        children: dict[str, Child] = {}
        for peer in PEERS:
            tell(f"rates: compiling {peer.name}")
            size = max((plan.scenarios or SCENARIOS) // peer.share, 1)
            children[peer.kind] = stack.enter_context(Child(peer.kind, plan.steps, sizes=[size]))
        _needed(children["engine"])
        there = [kind for kind, child in children.items() if child.missing is None]
        for i in range(plan.repeats):
            tell(f"rates: round {i + 1} of {plan.repeats}")
            for kind in there if i % 2 == 0 else reversed(there):  # a drift favours nobody
                seconds[kind].append(children[kind].seconds(children[kind].sizes[0]))
    work = {kind: children[kind].sizes[0] * plan.steps for kind in there}
    measured = {kind: [work[kind] / s for s in seconds[kind]] for kind in there}
    rows = [_row(peer, children[peer.kind], measured) for peer in PEERS if peer.kind in there]
    missing = {peer.name: children[peer.kind].missing for peer in PEERS if peer.kind not in there}
    return {"steps": plan.steps, "rows": rows, "missing": missing}


def _row(peer: Peer, child: Child, measured: dict[str, list[float]]) -> Table:
    """Rates of one peer and, unless it is the engine, the engine's over them."""
    rate, engine = summary(measured[peer.kind], max), summary(measured["engine"], max)
    row = {
        "kind": peer.kind,
        "name": peer.name,
        "scenarios": child.sizes[0],
        "first_s": child.first_s,
        "steps_per_s": rate,
    }
    if peer.kind == "engine":
        return row
    ratios = [a / b for a, b in zip(engine["all"], rate["all"], strict=True)]
    ratio = summary(ratios) | {"best": engine["best"] / rate["best"]}
    targets = within(ratio["median"], peer.at_least, peer.at_most)
    return row | {"engine_over_it": ratio} | targets


def scaling(plan: Plan, tell: Tell) -> Table:
    """Microseconds a scenario against their number, on all devices and on one."""
    sizes = list(DECADES_FULL if plan.full else DECADES)
    if plan.scenarios:
        sizes = sorted({max(plan.scenarios // part, 1) for part in (100, 10, 1)})
    rows = []
    with (
        Child("engine", plan.steps, sizes=sizes) as every,
        Child("one", plan.steps, sizes=sizes) as one,
    ):
        for child in (every, one):
            _needed(child)
        for n in sizes:
            tell(f"scaling: {n:,} scenarios")
            taken = [(every.seconds(n), one.seconds(n)) for _ in range(plan.rounds(n))]
            row = {
                "scenarios": n,
                "all_us": summary([1e6 * a / n for a, _ in taken]),
                "one_us": summary([1e6 * b / n for _, b in taken]),
                "one_over_all": summary([b / a for a, b in taken], max),
            }
            rows.append(row)
    return {"steps": plan.steps, "rows": rows, "missing": {}}


def _needed(child: Child) -> None:
    if child.missing is not None:
        raise BenchError(f"the engine: {child.missing}")
