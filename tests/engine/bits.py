"""Seeded scenarios and the SHA-256 of their metrics.

`python -m tests.engine.bits` records every reading of the model in tests/engine/bits.json, under
the arithmetic of this machine; test_bits.py compares with it. Raise `fic_jax.NUMERICS` when you
record other bits.
"""

import hashlib
import itertools
import json
import warnings
from pathlib import Path

import jax
import numpy as np

from benchmarks.scenarios import wide
from fic_jax import CHOICES, METRICS, Model, sweep
from fic_jax.engine import arithmetic

GOLDEN = Path(__file__).with_name("bits.json")
N, N_STEPS, DT, SEED = 4096, 200, 0.01, 20261126


def scenarios(dtype):
    """N scenarios over all fields, the same ones whenever the bits are recorded."""
    return jax.tree.map(lambda column: column.astype(dtype), wide(N, SEED))


def readings():
    """Every combination of the model's choices, by name."""
    for chosen in itertools.product(*CHOICES.values()):
        yield "-".join(chosen), Model(**dict(zip(CHOICES, chosen, strict=True)))


def digest(model, dtype, error_estimate=False, **options):
    """SHA-256 of the metrics' bits, field by field in the order of their names."""
    batch = scenarios(dtype)
    results = sweep(
        batch, model=model, dt=DT, n_steps=N_STEPS, error_estimate=error_estimate, **options
    )
    of_bytes = hashlib.sha256()
    for metrics in results if error_estimate else (results,):
        for name in sorted(METRICS):
            values = np.ascontiguousarray(getattr(metrics, name))
            of_bytes.update(name.encode() + np.where(np.isnan(values), 0, values).tobytes())
    return of_bytes.hexdigest()[:16]


def cases():
    """What is recorded: name, model, dtype, whether with error estimates."""
    for name, model in readings():
        for dtype in ("float32", "float64"):
            yield f"{name} {dtype}", model, dtype, False
    for integrator in CHOICES["integrator"]:
        for dtype in ("float32", "float64"):
            for contact in CHOICES["contact"]:
                model = Model(contact=contact, integrator=integrator)
                yield f"{contact}-{integrator} {dtype} estimate", model, dtype, True


def main():
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("error", RuntimeWarning)
    record = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}
    record[arithmetic()] = {name: digest(*case) for name, *case in cases()}
    GOLDEN.write_text(json.dumps(record, indent=0, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
