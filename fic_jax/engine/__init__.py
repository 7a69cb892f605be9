"""N scenarios: arrangement, devices, compilation. The physics knows nothing of any of them.

One program is compiled per (model, number of steps, dtype, devices). A scenario's bits depend on
nothing else: not on N, its neighbours, the number of devices or the chunking.
"""

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from typing import Any, Literal, overload

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax.accuracy import difference, estimated
from fic_jax.engine.xla import in_blocks
from fic_jax.metrics import Metrics, blank, compiled_evaluate
from fic_jax.params import QUANTITIES, Model, Params, ParamsError, check

# How the scenarios of a call are arranged on a platform; what is not named here is scanned.
ARRANGEMENT = {"cpu": "native", "gpu": "kernel"}
# Samples in one turn of the scan's time loop: two are 1.2 times faster than one, more only take
# longer to compile; a located step is long enough by itself.
UNROLL = {"rk4": 2, "rk4_events": 1}

# Vector registers that a value takes in a native kernel. With two, one instruction works while the
# other waits, and an undisturbed core is a tenth faster; two busy ones were slower.
REGISTERS = 1

# What is told where an arrangement can't be built.
SLOWER = {
    "native": "no vector kernel {where}: compiled by XLA instead, expect two fifths of the speed; "
    "`pip install llvmlite` if it is missing",
    "kernel": "no GPU kernel {where}: several launches for each plant step instead, expect a small "
    "part of the speed",
}

# XLA:CPU runs a loop's body as separate kernels, whose dispatch and memory traffic dominate; the
# threshold makes it compile the whole time loop as one function. The rest helps it to vectorise.
CPU_FLAGS = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000,"
    "xla_cpu_use_multi_output_fusion=true,xla_cpu_disable_tiled_emitter",
    "--xla_cpu_prefer_vector_width=512",
)
# XLA ends the process on a flag it does not know, so only versions tried get any.
TRIED_JAXLIB = ("0.10.", "0.11.", "0.12.")


def cores() -> int:
    """Cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def tune_for_throughput(devices: int | None = None) -> None:
    """Use `devices` CPU devices (default: all cores), and make XLA compile for sweeps.

    A CPU's sweeps then share that many cores; the flags matter where XLA compiles them (`SLOWER`).

    Call it before JAX starts; it sets XLA_FLAGS of this process, keeping those already there, and
    `jax_num_cpu_devices`. Where this jaxlib was never tried with them the flags are left alone,
    and a warning says so.

    Raises RuntimeError if JAX has already started.
    """
    # raises once a backend is up
    jax.config.update("jax_num_cpu_devices", cores() if devices is None else devices)
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
    wanted = [flag for flag in CPU_FLAGS if flag.split("=")[0] not in present]
    kept = [flag for flag in CPU_FLAGS if flag not in (*wanted, *present.split())]
    if kept:
        names = ", ".join(flag.split("=")[0] for flag in kept)
        warnings.warn(
            f"XLA_FLAGS already has {names}: left as it is, sweeps may be slower",
            RuntimeWarning,
            stacklevel=2,
        )
    os.environ["XLA_FLAGS"] = " ".join([present, *wanted]).strip()


@dataclass(frozen=True)
class Program:
    """What computes the results of N scenarios."""

    fill: Callable[[Sequence[np.ndarray], np.ndarray, Any], None]  # [N] quantities, dt, out
    result: Any  # the types of one scenario's result


@overload
def sweep(
    batch: Params,
    *,
    model: Model = ...,
    dt: float,
    n_steps: int,
    error_estimate: Literal[False] = ...,
) -> Metrics: ...


@overload
def sweep(
    batch: Params, *, model: Model = ..., dt: float, n_steps: int, error_estimate: Literal[True]
) -> tuple[Metrics, Metrics]: ...


def sweep(
    batch: Params,
    *,
    model: Model = Model(),
    dt: float,
    n_steps: int,
    error_estimate: bool = False,
) -> Metrics | tuple[Metrics, Metrics]:
    """Evaluate N scenarios: Params with [N] leaves (scalars broadcast) to Metrics of [N] arrays.

    All cores of a CPU (`tune_for_throughput` may ask for fewer) or all local GPUs share the work.
    The result of a scenario depends neither on N nor on its neighbours or who shares, bit for bit.
    The dtype follows the leaves. With `error_estimate` also the estimated error of every metric
    (`evaluate_with_error`), at several times the cost.

    Raises ParamsError if a value is out of bounds or the leaves' shapes differ.
    """
    dtype = np.dtype(jnp.result_type(float, *jax.tree.leaves(batch)))
    with np.errstate(over="ignore", under="ignore"):  # checked as the inf or zero it becomes
        leaves = [np.asarray(getattr(batch, name), dtype) for name in QUANTITIES]
    n = _length(leaves)
    check(Params(*leaves), dt, n_steps)
    devices = tuple(jax.local_devices())
    program = _compiled(model, n_steps, error_estimate, dtype, devices)
    out = jax.tree.map(lambda leaf: np.empty(n, leaf.dtype), program.result)
    columns = [np.broadcast_to(leaf.reshape(-1), n) for leaf in leaves]
    program.fill(columns, np.asarray(dt, dtype), out)
    return out


def _length(leaves: list[np.ndarray]) -> int:
    lengths = {leaf.shape for leaf in leaves if leaf.shape not in ((), (1,))} or {(1,)}
    if len(lengths) > 1 or len(min(lengths)) > 1:
        shapes = {k: leaf.shape for k, leaf in zip(QUANTITIES, leaves, strict=True) if leaf.ndim}
        raise ParamsError("batch", shapes, "scalars and [N] arrays of one length")
    return min(lengths)[0]


def _result(model: Model, error_estimate: bool, dtype: np.dtype) -> Any:
    """The types of one scenario's result, without tracing its time loop."""

    def of(p: Params, dt: jax.Array) -> Any:
        metrics = blank(p, dt)
        return (metrics, difference(metrics, metrics, model)) if error_estimate else metrics

    scalar = jax.ShapeDtypeStruct((), dtype)
    return jax.eval_shape(of, Params(**dict.fromkeys(QUANTITIES, scalar)), scalar)


@lru_cache
def _compiled(
    model: Model,
    n_steps: int,
    error_estimate: bool,
    dtype: np.dtype,
    devices: tuple[jax.Device, ...],
) -> Program:
    """The program for these devices, in the arrangement that suits them.

    Where that can't be built, a warning says so and scenarios are scanned in blocks.
    """
    result = _result(model, error_estimate, dtype)

    def built(arrangement: str) -> Program:
        unroll = UNROLL[model.integrator] if arrangement == "scan" else 1
        scenario = _scenario(model, n_steps, error_estimate, unroll)
        if arrangement == "native":
            from fic_jax.lanes import in_vectors  # llvmlite may not be there

            identity = f"{model} {n_steps} {error_estimate}"
            fill = in_vectors(
                scenario,
                len(QUANTITIES),
                result,
                dtype,
                registers=REGISTERS,
                threads=threads(devices),
                identity=identity,
            )
            return Program(fill, result)
        fill = in_blocks(arrangement, scenario, len(QUANTITIES), result, dtype, devices)
        return Program(fill, result)

    arrangement = ARRANGEMENT.get(devices[0].platform, "scan")
    if arrangement not in SLOWER:
        return built(arrangement)
    try:
        return built(arrangement)
    except Exception as error:  # whatever LLVM, Pallas, Triton or the driver make of it
        told = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        where = f"with jax {jax.__version__} on {devices[0].device_kind} ({told})"
        warnings.warn(SLOWER[arrangement].format(where=where), RuntimeWarning, stacklevel=3)
        return built("scan")


def threads(devices: Sequence[jax.Device]) -> int:
    """Cores that a CPU's scenarios share: all, or as many as CPU devices were asked for."""
    asked = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
    return len(devices) if asked > 0 else cores()


def _scenario(model: Model, n_steps: int, error_estimate: bool, unroll: int) -> Any:
    """One scenario, from its column of quantities and dt to its result."""
    one = estimated if error_estimate else compiled_evaluate

    def scenario(column: Sequence[jax.Array], dt: jax.Array) -> Any:
        params = Params(**dict(zip(QUANTITIES, column, strict=True)))
        return one(params, model, dt, n_steps, unroll=unroll)

    return scenario
