"""Compare the metrics of a backend with those of the CPU's lane compiler, bit for bit.

`correctness` compares every reading of the model; `bits` a million scenarios of the default one,
and lists those that differ most. Both sides run in the same process, on the same columns.
"""

import itertools
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.child import BenchError, Child, Missing
from benchmarks.gpu.results import missing
from benchmarks.gpu.session import LeftOut, Session
from benchmarks.plan import DT
from benchmarks.scenarios import wide
from benchmarks.tables import Row, Table
from fic_jax import CHOICES, METRICS, QUANTITIES, Metrics, Model, Params, sweep

SEED = 19
WORST = 5  # scenarios that `bits` lists
UNLIKE = np.uint64(2**64 - 1)  # the distance of NaN or infinity from other numbers
QUANTILES = (0.5, 0.99, 1.0)
# XLA's loop computes 128 scenarios at a time and launches kernels for each plant step
FEW = {"xla": 4096}


@dataclass(frozen=True)
class Case:
    """A comparison."""

    backend: str
    dtype: str
    choices: dict[str, str]
    scenarios: int
    steps: int
    listed: int = 0  # of the scenarios that differ most

    @property
    def reading(self) -> str:
        """The choices that are not the default, apart from the integrator."""
        default = vars(Model())
        changed = [
            f"{k}={v}" for k, v in self.choices.items() if k != "integrator" and v != default[k]
        ]
        return ", ".join(changed) or "default"

    @property
    def name(self) -> str:
        """Names the case in the results."""
        integrator = self.choices["integrator"]
        return f"{self.backend}, {integrator}, {self.dtype}, {self.reading}"


def readings(every: bool) -> Iterator[dict[str, str]]:
    """Choices of a model without its integrator: one option changed at a time, or `every` one."""
    options = {name: values for name, values in CHOICES.items() if name != "integrator"}
    if every:
        for values in itertools.product(*options.values()):
            yield dict(zip(options, values, strict=True))
        return
    default = {name: values[0] for name, values in options.items()}
    yield default
    for name, (_, *others) in options.items():
        yield from (default | {name: other} for other in others)


def correctness(session: Session) -> None:
    """Compare every reading, with the backends one after the other."""
    plan = session.plan
    cases = [
        Case(
            backend,
            dtype,
            {**reading, "integrator": integrator},
            min(plan.scenarios, FEW.get(backend, plan.scenarios)),
            plan.steps,
        )
        for backend in plan.backends
        for integrator in plan.integrators
        for dtype in plan.dtypes
        for reading in readings(plan.every)
    ]
    wanted = [case for case in cases if not plan.readings or case.reading in plan.readings]
    _compare("correctness", session, wanted)


def bits(session: Session) -> None:
    """Compare many scenarios of the default model with the first backend."""
    plan, default = session.plan, next(readings(every=False))
    cases = [
        Case(
            plan.backends[0],
            dtype,
            {**default, "integrator": integrator},
            plan.bits,
            plan.run_steps,
            WORST,
        )
        for dtype in plan.dtypes
        for integrator in plan.integrators
    ]
    _compare("bits", session, cases)


def _compare(part: str, session: Session, cases: Sequence[Case]) -> None:
    """Record each case. Each job has a child; after an error, the next case gets a fresh one."""
    waiting, done = iter(cases), itertools.count(1)

    def work(_: int) -> None:
        case = next(waiting, None)
        while case:
            with Child() as child:
                while case:
                    try:
                        found = session.ask(child, "benchmarks.gpu.agreement.compare", **vars(case))
                    except LeftOut as why:  # as for all that still wait
                        session.failed(part, case.name, why)
                        case = next(waiting, None)
                        continue
                    except (Missing, BenchError) as why:
                        session.failed(part, case.name, why)
                        case = next(waiting, None)
                        break
                    session.results.add(part, case.name, **vars(case), **found)
                    share = f"{100 * found['identical'] / case.scenarios:.4g} % identical"
                    session.say(f"{part}: {next(done)} of {len(cases)}: {case.name}: {share}")
                    case = next(waiting, None)

    session.side_by_side(work, range(session.plan.jobs))


# Called in a child:


def compare(
    backend: str, dtype: str, choices: dict[str, Any], scenarios: int, steps: int, listed: int
) -> Row:
    """Run seeded scenarios with the backend and with `lanes`; how their metrics differ."""
    import jax

    jax.config.update("jax_enable_x64", dtype == "float64")
    batch = jax.tree.map(lambda leaf: leaf.astype(dtype), wide(scenarios, SEED))
    model = Model(**choices)

    def timed(batch: Params, backend: Any) -> tuple[Metrics, float]:
        began = perf_counter()
        found = sweep(batch, model=model, dt=DT, n_steps=steps, backend=backend)
        return found, perf_counter() - began

    jax.numpy.zeros(()).block_until_ready()  # starts the device
    _, first_s = timed(jax.tree.map(lambda leaf: leaf[:1], batch), backend)  # compiles
    ours, run_s = timed(batch, backend)
    theirs, _ = timed(batch, "lanes")
    return {"first_s": first_s, "run_s": run_s} | differences(ours, theirs, batch, listed)


def differences(ours: Metrics, theirs: Metrics, batch: Params, listed: int = 0) -> Row:
    """Scenarios with identical bits (NaN equals NaN), and how far apart the others are.

    Distances are in units of the last place, quantiles over the numbers that differ.
    """
    distances = {
        name: apart(np.asarray(getattr(ours, name)), np.asarray(getattr(theirs, name)))
        for name in METRICS
    }
    farthest = np.max(list(distances.values()), axis=0)
    differing = {name: d for name, d in distances.items() if d.any()}
    row: Row = {
        "identical": int((farthest == 0).sum()),
        "finite_differs": int((distances["finite"] != 0).sum()),
        "unlike": int((farthest == UNLIKE).sum()),
        "metrics": {},
        "ulps": _quantiles(
            [d for n, d in differing.items() if n not in ("mode_switches", "finite")]
        ),
        "worst": [],
    }
    for name, d in differing.items():
        one, other = (np.asarray(getattr(m, name), np.float64) for m in (ours, theirs))
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            relative = np.abs(one - other) / np.maximum(np.abs(one), np.abs(other))
        row["metrics"][name] = {
            "differ": int((d != 0).sum()),
            "unlike": int((d == UNLIKE).sum()),
            "ulps": _quantiles([d]),
            "relative": float(np.max(relative, where=(d != 0) & np.isfinite(relative), initial=0)),
        }
    for i in np.argsort(farthest)[::-1][:listed]:
        if farthest[i]:
            pairs = {n: (getattr(ours, n)[i], getattr(theirs, n)[i]) for n in differing}
            row["worst"].append(
                {
                    "params": {n: float(getattr(batch, n)[i]) for n in QUANTITIES},
                    "metrics": {
                        n: [str(one), str(other)]
                        for n, (one, other) in pairs.items()
                        if distances[n][i]
                    },
                }
            )
    return row


def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How many numbers of the type lie between two, 0 if the bits are equal; uint64.

    NaN equals NaN. NaN or infinity and another number are UNLIKE.
    """
    if one.dtype.kind != "f":
        return np.abs(one.astype(np.int64) - other.astype(np.int64)).astype(np.uint64)
    unsigned = np.dtype(f"u{one.dtype.itemsize}").type
    sign = unsigned(1 << (8 * one.dtype.itemsize - 1))

    def place(a: np.ndarray) -> np.ndarray:
        """The place of each number in the order of all."""
        of_bits = np.ascontiguousarray(a).view(unsigned)
        return np.where(of_bits & sign, ~of_bits, of_bits | sign)

    a, b = place(one), place(other)
    distance = np.where(a > b, a - b, b - a).astype(np.uint64)
    distance[np.isnan(one) & np.isnan(other)] = 0
    within = np.isfinite(one) & np.isfinite(other)
    distance[(distance != 0) & ~within] = UNLIKE
    return distance


def _quantiles(distances: list[np.ndarray]) -> list[float]:
    """Quantiles of the distances that are neither 0 nor UNLIKE; empty without any."""
    counted = [d[(d != 0) & (d != UNLIKE)] for d in distances]
    together = np.sort(np.concatenate([*counted, np.zeros(0, np.uint64)]))
    if not together.size:
        return []
    return [float(together[int(np.ceil(q * together.size)) - 1]) for q in QUANTILES]


# The tables:

COLUMNS = [
    ("", "{backend}"),
    ("integrator", "{integrator}"),
    ("dtype", "{dtype}"),
    ("reading", "{reading}"),
    ("scenarios", "{scenarios:,}"),
    ("identical, %", "{share:.4f}"),
    ("differ", "{n_differ:,}"),
    ("ulps, median", "{ulps[0]:.3g}"),
    ("99 %", "{ulps[1]:.3g}"),
    ("100 %", "{ulps[2]:.3g}"),
    ("largest relative", "{relative:.1e}"),
    ("finite or not differs", "{finite_differs:,}"),
    ("first call, s", "{first_s:.1f}"),
    ("run, s", "{run_s:.2f}"),
    ("metrics that differ", "{differing}"),
]


def tables_of_correctness(records: list[Row]) -> list[Table]:
    """A summary of each backend, and a row for each reading."""
    rows = _rows(records)
    steps = rows[0]["steps"] if rows else 0
    summary = Table(
        f"Correctness: metrics of random scenarios against the CPU's lanes, {steps:,} steps",
        [
            ("", "{backend}"),
            ("integrator", "{integrator}"),
            ("dtype", "{dtype}"),
            ("readings", "{readings}"),
            ("scenarios", "{scenarios:,}"),
            ("identical, %", "{share:.4f}"),
            ("worst reading, %", "{least:.4f}"),
            ("largest, ulps", "{ulps:.3g}"),
            ("finite or not differs", "{finite_differs:,}"),
            ("first call, s, median", "{first_s:.1f}"),
        ],
        [_summed(group) for group in _grouped(rows).values()],
        missing(records),
    )
    return [summary, Table("Correctness, each reading", COLUMNS, rows)] if records else []


def tables_of_bits(records: list[Row]) -> list[Table]:
    """A row for each precision and integrator, one for each metric, and the worst scenarios."""
    rows = _rows(records)
    steps = rows[0]["steps"] if rows else 0
    by_metric = [
        {"case": row["case"], "metric": name, "n": row["scenarios"], **values}
        for row in rows
        for name, values in row["metrics"].items()
    ]
    worst = [
        {
            "case": row["case"],
            "params": ", ".join(f"{k}={v!r}" for k, v in scenario["params"].items()),
            "metrics": "; ".join(f"{k} {a}, {b}" for k, (a, b) in scenario["metrics"].items()),
        }
        for row in rows
        for scenario in row["worst"]
    ]
    title = f"Bits: random scenarios of the default model against the CPU's lanes, {steps:,} steps"
    every = [
        Table(title, COLUMNS, rows, missing(records)),
        Table(
            "Bits, each metric that differs",
            [
                ("", "{case}"),
                ("metric", "{metric}"),
                ("differ", "{differ:,}"),
                ("of", "{n:,}"),
                ("NaN or infinite on one side", "{unlike:,}"),
                ("ulps, median", "{ulps[0]:.3g}"),
                ("99 %", "{ulps[1]:.3g}"),
                ("100 %", "{ulps[2]:.3g}"),
                ("largest relative", "{relative:.1e}"),
            ],
            by_metric,
        ),
        Table(
            "Bits, the scenarios that differ most",
            [("", "{case}"), ("Params", "{params}"), ("here, lanes", "{metrics}")],
            worst,
        ),
    ]
    return [table for table in every if table.rows or table.notes]


def _rows(records: list[Row]) -> list[Row]:
    return [
        record
        | {
            "integrator": record["choices"]["integrator"],
            "reading": Case(**{k: record[k] for k in Case.__dataclass_fields__}).reading,
            "share": 100 * record["identical"] / record["scenarios"],
            "n_differ": record["scenarios"] - record["identical"],
            "relative": max((m["relative"] for m in record["metrics"].values()), default=0.0),
            "differing": ", ".join(f"{k} {m['differ']:,}" for k, m in record["metrics"].items()),
        }
        for record in records
        if "why" not in record
    ]


def _grouped(rows: list[Row]) -> dict[tuple[str, ...], list[Row]]:
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["backend"], row["integrator"], row["dtype"]), []).append(row)
    return groups


def _summed(group: list[Row]) -> Row:
    scenarios = sum(row["scenarios"] for row in group)
    return {
        **{name: group[0][name] for name in ("backend", "integrator", "dtype")},
        "readings": len(group),
        "scenarios": scenarios,
        "share": 100 * sum(row["identical"] for row in group) / scenarios,
        "least": min(row["share"] for row in group),
        "ulps": max((row["ulps"][2] for row in group if row["ulps"]), default=0.0),
        "finite_differs": sum(row["finite_differs"] for row in group),
        "first_s": statistics.median(row["first_s"] for row in group),
    }
