"""fic_jax: the Fractal Impedance Controller (Tiseo et al. 2020), simulated by the million."""

from fic_jax._version import NUMERICS, __version__
from fic_jax.accuracy import TRUST, Bound, evaluate_with_error, trusted
from fic_jax.engine import histories, sweep, tune_for_throughput
from fic_jax.inputs import ParamsError
from fic_jax.metrics import METRICS, Metrics, evaluate
from fic_jax.params import CHOICES, QUANTITIES, Model, Params
from fic_jax.profile import energy, force
from fic_jax.simulation import SIGNALS, Memory, Sample, State, control, init, rollout, step

__all__ = [
    "CHOICES",
    "METRICS",
    "NUMERICS",
    "QUANTITIES",
    "SIGNALS",
    "TRUST",
    "Bound",
    "Memory",
    "Metrics",
    "Model",
    "Params",
    "ParamsError",
    "Sample",
    "State",
    "__version__",
    "control",
    "energy",
    "evaluate",
    "evaluate_with_error",
    "force",
    "histories",
    "init",
    "rollout",
    "step",
    "sweep",
    "trusted",
    "tune_for_throughput",
]
