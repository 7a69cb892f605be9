"""N scenarios: blocks, devices, compilation. The physics knows nothing of any of them.

One program is compiled per (model, number of steps, dtype, devices), of one fixed shape, and run
as often as N asks for. XLA may round differently in programs of different shapes; one shape makes
a scenario's bits independent of N, of its neighbours and of the chunking.
"""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from typing import Any, Literal, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from fic_jax.accuracy import difference, estimated
from fic_jax.metrics import Metrics, blank, compiled_evaluate
from fic_jax.params import QUANTITIES, Model, Params, ParamsError, check

# Scenarios that advance together. Their state has to stay in the L1 cache and fill whole vectors;
# 64 to 256 were within 10 % of each other, 512 slower.
LANES = 128
# Samples in one turn of the time loop: two are 1.2 times faster than one, more only take longer to
# compile; a located step is long enough by itself.
UNROLL = {"rk4": 2, "rk4_events": 1}
# How the scenarios of a call are arranged on a platform; what is not named here is scanned.
ARRANGEMENT = {"gpu": "kernel"}
# Blocks that one call holds for each device: some tenths of a second of work at 1,000 steps.
BLOCKS = {"scan": 128, "kernel": 8192, "interpreted": 4}

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
    """Make JAX compile for sweeps and use `devices` CPU devices (default: all cores).

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
            f"(they were with {tried}): they are left out, expect a third of the speed",
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
    """What runs one call."""

    run: Any  # columns, dt, blocks -> results
    sharding: NamedSharding  # of the columns
    result: Any  # the types of one scenario's result
    blocks: int  # that a call holds for each device


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

    All local devices share the work. The result of a scenario does not depend on N, on its
    neighbours or on the number of devices, bit for bit. The dtype follows the leaves. With
    `error_estimate` also the estimated error of every metric (`evaluate_with_error`), at several
    times the cost.

    Raises ParamsError if a value is out of bounds or the leaves' shapes differ.
    """
    dtype = np.dtype(jnp.result_type(float, *jax.tree.leaves(batch)))
    with np.errstate(over="ignore", under="ignore"):  # checked as the inf or zero it becomes
        leaves = [np.asarray(getattr(batch, name), dtype) for name in QUANTITIES]
    n = _length(leaves)
    check(Params(*leaves), dt, n_steps)
    devices = tuple(jax.local_devices())
    program = _compiled(model, n_steps, error_estimate, dtype, devices)
    capacity = len(devices) * program.blocks * LANES
    out = jax.tree.map(lambda leaf: np.empty(n, leaf.dtype), program.result)
    for start in range(0, n, capacity):
        part = slice(start, min(start + capacity, n))
        columns, blocks = _pack(leaves, part, dtype, len(devices), program.blocks)
        placed = jax.device_put(columns, program.sharding)
        metrics = program.run(placed, np.asarray(dt, dtype), blocks)
        _unpack(metrics, out, part, blocks)
    return out


def _length(leaves: list[np.ndarray]) -> int:
    lengths = {leaf.shape for leaf in leaves if leaf.shape not in ((), (1,))} or {(1,)}
    if len(lengths) > 1 or len(min(lengths)) > 1:
        shapes = {k: leaf.shape for k, leaf in zip(QUANTITIES, leaves, strict=True) if leaf.ndim}
        raise ParamsError("batch", shapes, "scalars and [N] arrays of one length")
    return min(lengths)[0]


def _pack(
    leaves: list[np.ndarray], part: slice, dtype: np.dtype, n_devices: int, n_blocks: int
) -> tuple[np.ndarray, np.int32]:
    """Scenarios `part` as [field, device, block, lane], and the blocks each device has to run.

    Devices get equal shares; the lanes left over repeat the last scenario.
    """
    n = part.stop - part.start
    blocks = -(-n // (LANES * n_devices))
    columns = np.empty((len(leaves), n_devices, n_blocks, LANES), dtype)
    lanes = np.empty(n_devices * blocks * LANES, dtype)
    for column, leaf in zip(columns, leaves, strict=True):
        lanes[:n] = leaf[part] if leaf.ndim and leaf.size > 1 else leaf
        lanes[n:] = lanes[n - 1]
        column[:, :blocks] = lanes.reshape(n_devices, blocks, LANES)
        column[:, blocks:] = lanes[0]
    return columns, np.int32(blocks)


def _unpack(computed: Any, out: Any, part: slice, blocks: np.int32) -> None:
    for source, values in zip(jax.tree.leaves(computed), jax.tree.leaves(out), strict=True):
        values[part] = np.asarray(source)[:, :blocks].reshape(-1)[: part.stop - part.start]


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
    """The program for one call on these devices, in the arrangement that suits them.

    Where a GPU's kernel can't be built, a warning says so and the scan is used there as well.
    """
    arrangement = ARRANGEMENT.get(devices[0].platform, "scan")
    if arrangement == "kernel":
        try:
            return _built(arrangement, model, n_steps, error_estimate, dtype, devices)
        except Exception as error:  # whatever Pallas, Triton or the driver make of it
            told = f"{type(error).__name__}: {error}".splitlines()[0][:200]
            warnings.warn(
                f"no GPU kernel with jax {jax.__version__} on {devices[0].device_kind} ({told}): "
                "several launches for each plant step instead, expect a small part of the speed",
                RuntimeWarning,
                stacklevel=3,
            )
            arrangement = "scan"
    return _built(arrangement, model, n_steps, error_estimate, dtype, devices)


def _built(
    arrangement: str,
    model: Model,
    n_steps: int,
    error_estimate: bool,
    dtype: np.dtype,
    devices: tuple[jax.Device, ...],
) -> Program:
    """A program that takes [field, device, block, lane] to results of [device, block, lane].

    The number of blocks is a value, not a shape: a ragged end runs the same code on fewer blocks.
    """
    unroll = UNROLL[model.integrator] if arrangement == "scan" else 1
    scenario = _scenario(model, n_steps, error_estimate, unroll)
    result = _result(model, error_estimate, dtype)
    if arrangement == "scan":
        of_device = _in_blocks(jax.vmap(scenario, in_axes=(1, None)), result)
    else:
        from fic_jax.kernel import in_one_kernel  # Pallas takes a while to import

        of_device = in_one_kernel(
            scenario, result, lanes=LANES, interpret=arrangement == "interpreted"
        )

    def on_device(columns: jax.Array, dt: jax.Array, blocks: jax.Array) -> Any:
        return jax.tree.map(lambda o: o[None], of_device(columns[:, 0], dt, blocks))

    mesh = Mesh(np.array(devices), ("device",))
    spec = P(None, "device")
    shares = jax.jit(
        jax.shard_map(
            on_device,
            mesh=mesh,
            in_specs=(spec, P(), P()),
            out_specs=P("device"),
            check_vma=False,
        )
    )
    sharding, blocks = NamedSharding(mesh, spec), BLOCKS[arrangement]
    if arrangement != "kernel":
        return Program(shares, sharding, result, blocks)
    shape = (len(QUANTITIES), len(devices), blocks, LANES)
    columns = jax.ShapeDtypeStruct(shape, dtype, sharding=sharding)
    with warnings.catch_warnings():
        # jax 0.11 announces Triton's end; Mosaic, its successor, asks for a Hopper GPU
        warnings.filterwarnings("ignore", "The Pallas Triton backend", DeprecationWarning)
        run = shares.lower(columns, np.zeros((), dtype), np.int32(0)).compile()
    return Program(run, sharding, result, blocks)


def _scenario(model: Model, n_steps: int, error_estimate: bool, unroll: int) -> Any:
    """One scenario, from its column of quantities and dt to its result."""
    one = estimated if error_estimate else compiled_evaluate

    def scenario(column: Sequence[jax.Array], dt: jax.Array) -> Any:
        params = Params(**dict(zip(QUANTITIES, column, strict=True)))
        return one(params, model, dt, n_steps, unroll=unroll)

    return scenario


def _in_blocks(block: Any, result: Any) -> Any:
    """Block after block, each with its whole time loop: what a CPU's first cache can hold."""

    def of_device(columns: jax.Array, dt: jax.Array, blocks: jax.Array) -> Any:
        def body(i: jax.Array, out: Any) -> Any:
            return jax.tree.map(lambda o, m: o.at[i].set(m), out, block(columns[:, i], dt))

        shape = columns.shape[1:]
        out = jax.tree.map(lambda leaf: jnp.zeros(shape, leaf.dtype), result)
        return jax.lax.fori_loop(0, blocks, body, out)

    return of_device
