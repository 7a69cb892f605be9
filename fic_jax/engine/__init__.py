"""N scenarios: sweeps, histories, backends and devices. The physics imports nothing from here.

    sweeping.py     `sweep`: chooses a backend, which compiles the time loop of one scenario
    histories.py    `histories`: the motion of N scenarios as an xarray.Dataset
    xla.py          backend: XLA, in blocks of one fixed shape, over all devices
    pallas.py       backend: the same blocks as one kernel of a GPU
    (fic_jax.lanes  backends lanes and ptx: this package's compiler for CPUs and NVIDIA GPUs)
    tuning.py       `tune_for_throughput`: XLA's flags and the number of cores

A sweep compiles one program per (backend, model, number of steps, dtype, devices). A scenario's
bits depend on nothing else: not on N, its neighbours, the number of devices or of calls.
"""

from fic_jax.engine.histories import histories
from fic_jax.engine.sweeping import Backend, arithmetic, sweep
from fic_jax.engine.tuning import tune_for_throughput

__all__ = ["Backend", "arithmetic", "histories", "sweep", "tune_for_throughput"]
