"""Random batches of scenarios, and comparing their metrics."""

import numpy as np

from fic_jax import METRICS, Params

DT = 0.01


def random_batch(n, seed=0, dtype=np.float64):
    rng = np.random.default_rng(seed)
    columns = {
        "K0": np.exp(rng.uniform(0.0, 6.9, n)),
        "Kenv": rng.uniform(10.0, 800.0, n),
        "Denv": rng.uniform(0.0, 300.0, n),
        "Td": rng.uniform(1.0, 20.0, n),
        "gap": rng.choice([0.0, 0.5], n),
        "period": DT * rng.integers(1, 10, n),
    }
    return Params(**{name: column.astype(dtype) for name, column in columns.items()})


def pick(batch, index):
    return Params(**{k: v[index] if np.ndim(v) else v for k, v in vars(batch).items()})


def assert_same(one, other):
    for name in METRICS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
