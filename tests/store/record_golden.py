"""Record the golden store of today's format: `python -m tests.store.record_golden`.

Its numbers follow from its parameters, not from the physics, so that they need no new record when
a metric changes. Block 1 fails, block 3 is not run, Kenv = 1e9 diverges.
"""

from unittest.mock import patch

import numpy as np

from fic_jax import METRICS, Metrics
from sweeps import runner
from sweeps.plan.grid import cells_of
from sweeps.spec.reading import parse
from sweeps.store.format import FORMAT
from tests.store.conftest import GOLDEN
from tests.store.test_golden import PLAN


def formula(grid, block, dtype, cells=slice(None)):
    """Instead of the engine; nmse is trusted at Td = 1, peak_torque where gap = 0."""
    if block == grid.block(1):
        raise RuntimeError("out of memory")
    n, p = cells_of(block), grid.params(block, dtype)
    Td, gap, Kenv = (np.broadcast_to(v, n)[cells] for v in (p.Td, p.gap, p.Kenv))
    zero = dict.fromkeys(METRICS, np.zeros_like(Td)) | {"finite": Kenv < 1e9}
    values = {"nmse": 0.125 * Td + 5 * gap, "peak_torque": 2 * Td}
    errors = {"nmse": (Td > 1).astype(dtype), "peak_torque": (gap > 0).astype(dtype)}
    return Metrics(**zero | values), Metrics(**zero | errors)


def main():
    store = runner.start(GOLDEN / f"format-{FORMAT}.zarr", parse(PLAN, "golden.toml"), 4, 32)
    with patch.object(runner, "_compute", formula):
        runner.run(store, lambda _: None, only={0, 1, 2})


if __name__ == "__main__":
    main()
