"""`tune_for_throughput`: XLA's flags and the number of cores, set once before JAX starts."""

import os
import warnings
from collections.abc import Sequence
from importlib.metadata import version

import jax

from fic_jax.inputs import count
from fic_jax.lanes import cores

# XLA:CPU runs a loop's body as separate kernels, whose dispatch and memory traffic dominate; the
# threshold makes it compile the whole time loop as one function. The rest helps it to vectorise.
CPU_FLAGS = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000,"
    "xla_cpu_use_multi_output_fusion=true,xla_cpu_disable_tiled_emitter",
    "--xla_cpu_prefer_vector_width=512",
)
# XLA ends the process on an unknown flag, so only the versions that we tried get any.
TRIED_JAXLIB = ("0.10.", "0.11.", "0.12.")


def tune_for_throughput(devices: int | None = None) -> None:
    """Give sweeps `devices` CPU cores (default: all) and the XLA flags that make them fast.

    Call it before JAX starts. It sets `jax_num_cpu_devices` and adds to this process's XLA_FLAGS,
    which the backend `xla` needs. It does not replace flags that are set, and it adds none on a
    jaxlib that was not tried with them; in both cases it warns.

    Raises RuntimeError if JAX has already started, ParamsError if `devices` is no number of cores.
    """
    n = cores() if devices is None else count("devices", devices)
    jax.config.update("jax_num_cpu_devices", n)  # raises once a backend is up
    if not version("jaxlib").startswith(TRIED_JAXLIB):
        tried = ", ".join(f"{v}x" for v in TRIED_JAXLIB)
        warnings.warn(
            f"jaxlib {version('jaxlib')} was not tried with the XLA flags that make sweeps fast "
            f"(they were with {tried}): they are left out, expect a third of XLA's speed",
            RuntimeWarning,
            stacklevel=2,
        )
        return
    present = os.environ.get("XLA_FLAGS", "")
    missing = [flag for flag in CPU_FLAGS if flag.split("=")[0] not in present]
    changed = [flag for flag in CPU_FLAGS if flag not in (*missing, *present.split())]
    if changed:
        names = ", ".join(flag.split("=")[0] for flag in changed)
        warnings.warn(
            f"XLA_FLAGS already has {names}: left as it is, sweeps may be slower",
            RuntimeWarning,
            stacklevel=2,
        )
    os.environ["XLA_FLAGS"] = " ".join([present, *missing]).strip()


def threads(devices: Sequence[jax.Device]) -> int:
    """Cores that a CPU's scenarios share: all, or as many as `tune_for_throughput` was given."""
    chosen = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
    return len(devices) if chosen > 0 else cores()
