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

from fic_jax import CHOICES, METRICS, Model, Params, sweep
from fic_jax.engine import arithmetic

GOLDEN = Path(__file__).with_name("bits.json")
N, N_STEPS, DT = 4096, 200, 0.01


def scenarios(dtype):
    """N scenarios over all fields: both signs of Td, overshooting profiles, approaches."""
    rng = np.random.default_rng(20261126)

    def log(low, high):
        return np.exp(rng.uniform(np.log(low), np.log(high), N))

    gap = np.where(rng.random(N) < 0.5, 0.0, rng.uniform(-0.1, 0.5, N))
    x0 = rng.uniform(0.05, 0.15, N)
    columns = {
        "K0": log(0.5, 1000.0),
        "Fmax": rng.uniform(5.0, 30.0, N),
        "x0": x0,
        "xb": x0 + rng.uniform(0.005, 0.05, N),
        "S": rng.uniform(5.0, 30.0, N),
        "Td": np.where(rng.random(N) < 0.1, -1.0, 1.0) * log(0.5, 20.0),
        "xd": np.where(rng.random(N) < 0.5, gap, 0.0),
        "sigma": log(0.001, 0.1),
        "period": DT * rng.integers(1, 6, N),
        "I": log(1.0, 20.0),
        "Kenv": log(10.0, 1000.0),
        "Denv": np.where(rng.random(N) < 0.2, 0.0, rng.uniform(0.0, 300.0, N)),
        "gap": gap,
        "x_init": np.where(rng.random(N) < 0.5, 0.0, rng.uniform(-0.2, 0.2, N)),
        "v_init": np.where(rng.random(N) < 0.5, 0.0, rng.uniform(-1.0, 1.0, N)),
    }
    return Params(**{name: column.astype(dtype) for name, column in columns.items()})


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
