"""A sweep of a thousand million scenarios whose metrics never leave the card.

The scenarios are the product of five axes. A jitted function computes a block of them from the
block's index, calls `sweep` inside of the jit, and reduces the metrics: the worst nmse over the
environments for each sigma, and the best sigma.
"""

from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.child import BenchError, Child, Missing
from benchmarks.gpu.results import missing
from benchmarks.gpu.session import LeftOut, Session
from benchmarks.plan import DT
from benchmarks.tables import Row, Table, measured
from fic_jax import Params, sweep
from fic_jax.engine import Backend

AXES = {  # K0 counts blocks; then Kenv, sigma, and the environments that are reduced
    "K0": np.geomspace(1.0, 1000.0, 100),
    "Kenv": np.geomspace(10.0, 1000.0, 100),
    "sigma": np.geomspace(0.001, 0.1, 100),
    "Denv": np.geomspace(1.0, 1000.0, 50),
    "Td": np.linspace(1.0, 20.0, 20),
}
SMALL = 4  # values of an axis, at most, in a trial on the CPU


def measure(session: Session) -> None:
    """Record the seconds of the whole sweep, compiled before, twice."""
    plan, case = session.plan, "product of five axes"
    backend = plan.backends[0]
    most = max(map(len, AXES.values())) if backend == "ptx" else SMALL
    for i in range(2):
        session.say(f"reduced: {case}, round {i + 1}")
        try:
            with Child() as child:
                arguments = {"backend": backend, "steps": plan.run_steps, "most": most}
                taken = session.ask(child, "benchmarks.gpu.reduced.timed", **arguments)
        except (BenchError, Missing, LeftOut) as why:
            session.failed("reduced", case, why)
            return
        session.results.add("reduced", case, i, steps=plan.run_steps, **taken)


def timed(backend: str, steps: int, most: int) -> Row:
    """Seconds of the sweep, and what it found (in a child)."""
    # the other backends can't be called inside a jit
    chosen: Backend = "ptx" if backend == "ptx" else "lanes"
    axes = {name: jnp.asarray(values[:most], jnp.float32) for name, values in AXES.items()}
    inner = tuple(len(axes[name]) for name in list(axes)[1:])

    @jax.jit
    def best(block: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        places = jnp.unravel_index(jnp.arange(np.prod(inner)), inner)
        batch = {name: axes[name][i] for name, i in zip(list(axes)[1:], places, strict=True)}
        p = Params(K0=axes["K0"][block], **batch)
        metrics = sweep(p, dt=DT, n_steps=steps, backend=chosen)
        nmse = jnp.where(metrics.finite, metrics.nmse, jnp.inf).reshape(*inner[:2], -1)
        worst = jnp.max(nmse, axis=2)
        return jnp.argmin(worst, 1), jnp.min(worst, 1), jnp.sum(~metrics.finite)

    blocks = range(len(axes["K0"]))
    jax.block_until_ready(best(0))
    began = perf_counter()
    found = jax.device_get([best(i) for i in blocks])
    seconds = perf_counter() - began
    n = len(blocks) * int(np.prod(inner))
    kept = sum(sigma.nbytes + nmse.nbytes for sigma, nmse, _ in found)
    diverged = sum(int(count) for _, _, count in found)
    return {"scenarios": n, "seconds": seconds, "kept_bytes": kept, "diverged": diverged}


def tables(records: list[Row]) -> list[Table]:
    """One row."""
    rounds = [r for r in records if "why" not in r]
    rows = []
    if rounds:
        seconds = measured([r["seconds"] for r in rounds], at_most=60.0)
        rate = rounds[0]["scenarios"] * rounds[0]["steps"] / seconds["median"] / 1e9
        rows = [{**rounds[0], "s": seconds, "rate": rate}]
    table = Table(
        "Reduced: scenarios made and metrics reduced on the card (best sigma of the worst case)",
        [
            ("scenarios", "{scenarios:,}"),
            ("steps", "{steps:,}"),
            ("s, median", "{s[median]:.3g}"),
            ("best", "{s[best]:.3g}"),
            ("target", "{s[target]}"),
            ("met", "{s[met]}"),
            ("10^9 plant steps a second", "{rate:.4g}"),
            ("bytes of the result", "{kept_bytes:,}"),
            ("diverged", "{diverged:,}"),
        ],
        rows,
        missing(records),
    )
    return [table] if records else []
