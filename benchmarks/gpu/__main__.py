"""`python -m benchmarks.gpu`: everything that is measured on an NVIDIA card, and its tables.

    python -m benchmarks.gpu [--out FOLDER] [--only PART ...] [--limit SECONDS]

A second command with the same folder adds to its results; `--tables` measures nothing and writes
the tables of what is there. `--cpu` tries the commands without a card: it measures no card.
"""

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import get_args

from benchmarks.gpu import agreement, card, memory, reduced, speed
from benchmarks.gpu.results import Results
from benchmarks.gpu.session import Plan, Session
from benchmarks.tables import Row, Table
from fic_jax import CHOICES
from fic_jax.engine import Backend
from fic_jax.lanes import cores

# name: what measures, what makes its tables, its share of the time
Part = tuple[Callable[[Session], None], Callable[[list[Row]], list[Table]], float]
PARTS: dict[str, Part] = {
    "machine": (card.measure, card.tables, 0.05),
    "bits": (agreement.bits, agreement.tables_of_bits, 0.10),
    "rates": (speed.measure, speed.tables, 0.40),
    "reduced": (reduced.measure, reduced.tables, 0.05),
    "memory": (memory.measure, memory.tables, 0.05),
    "correctness": (agreement.correctness, agreement.tables_of_correctness, 0.40),
}
# the first is compared with all others
BACKENDS = [name for name in ("ptx", "pallas", "xla") if name in get_args(Backend)]


def main() -> int:
    """Measure the wanted parts, and write the tables after each."""
    options = _options()
    root = str(Path(__file__).parents[2])
    os.environ["PYTHONPATH"] = os.pathsep.join(
        filter(None, [root, os.environ.get("PYTHONPATH", "")])
    )
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # the children share the card
    if options.cpu:
        os.environ["JAX_PLATFORMS"] = "cpu"
    elif not options.tables and (why := card.no_card()):
        return _refuse(f"no NVIDIA card ({why}); --cpu tries the commands on the CPU")
    else:  # JAX says so if it can't use the card, and takes no other device for it
        os.environ.setdefault("JAX_PLATFORMS", "cuda,cpu")
    session = Session(_plan(options), Results(options.out))
    wanted = [] if options.tables else [name for name in PARTS if name in (options.only or PARTS)]
    end, failed = monotonic() + options.limit, False
    for i, name in enumerate(wanted):
        measure, _, share = PARTS[name]
        to_come = sum(PARTS[other][2] for other in wanted[i:])
        session.deadline = monotonic() + (end - monotonic()) * share / to_come
        session.say(f"{name}: at most {session.deadline - monotonic():.0f} s")
        session.results.begin(name)
        try:
            measure(session)
        except KeyboardInterrupt:
            _write(session.results)
            return _refuse("interrupted; the results so far are in " + str(options.out), 1)
        except Exception as error:  # one part's mistake must not cost the others their card
            failed = True
            session.failed(name, "the whole part", error)
        _write(session.results)
    session.say(f"tables: {_write(session.results)}")
    return int(failed)


def _write(results: Results) -> Path:
    return results.write({name: tables(results.of(name)) for name, (_, tables, _) in PARTS.items()})


def _plan(options: argparse.Namespace) -> Plan:
    first = ["xla"] if options.cpu else BACKENDS
    return Plan(
        backends=tuple(options.backend or first),
        dtypes=tuple(options.dtype or ("float32", "float64")),
        integrators=tuple(options.integrator or CHOICES["integrator"]),
        readings=tuple(options.reading),
        every=options.all,
        scenarios=options.scenarios,
        steps=options.steps,
        bits=options.bits,
        sizes=tuple(sorted(options.sizes)),
        run_steps=options.run_steps,
        repeats=options.repeats,
        jobs=options.jobs,
    )


def _refuse(why: str, code: int = 2) -> int:
    sys.stderr.write(f"python -m benchmarks.gpu: {why}\n")
    return code


def _options() -> argparse.Namespace:
    def at_least(least: int) -> Callable[[str], int]:
        def number(text: str) -> int:
            value = int(float(text)) if "e" in text else int(text)
            if value < least:
                raise argparse.ArgumentTypeError(f"{text} is less than {least}")
            return value

        number.__name__ = "number"
        return number

    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu", description=(__doc__ or "").splitlines()[0]
    )
    add = parser.add_argument
    several = {"action": "append", "default": []}
    add("--out", type=Path, default=Path("results/gpu"), help="folder (default: %(default)s)")
    add("--only", choices=PARTS, help="this part, repeatable", **several)  # type: ignore[arg-type]
    add("--limit", type=at_least(1), default=1500, help="seconds of all parts (%(default)s)")
    add("--backend", choices=BACKENDS, help="repeatable; the first is compared", **several)  # type: ignore[arg-type]
    add("--dtype", choices=("float32", "float64"), help="repeatable", **several)  # type: ignore[arg-type]
    add("--integrator", choices=CHOICES["integrator"], help="repeatable", **several)  # type: ignore[arg-type]
    add("--reading", help="of correctness: default, contact=welded, ...", **several)  # type: ignore[arg-type]
    add("--all", action="store_true", help="correctness: every combination of options")
    add("--scenarios", type=at_least(1), default=100_000, help="of a reading (%(default)s)")
    add("--steps", type=at_least(2), default=200, help="plant steps of a reading (%(default)s)")
    add("--bits", type=at_least(1), default=1_000_000, help="scenarios of bits (%(default)s)")
    sizes = [100_000, 1_000_000, 10_000_000]
    add("--sizes", type=at_least(1), nargs="+", default=sizes, help="scenarios of the rates")
    add("--run-steps", type=at_least(2), default=1_000, help="of the other parts (%(default)s)")
    add("--repeats", type=at_least(1), default=5, help="rounds of the rates (%(default)s)")
    jobs = max(cores() // 2, 1)
    add("--jobs", type=at_least(1), default=jobs, help="processes that compile (%(default)s)")
    add("--cpu", action="store_true", help="try the commands on the CPU")
    add("--tables", action="store_true", help="only write the tables of the results in the folder")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
