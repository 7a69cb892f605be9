"""`sweep`: N scenarios through the backend that suits the device."""

import importlib.util
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import DynamicJaxprTracer

from fic_jax.accuracy import difference, estimated
from fic_jax.engine.tuning import threads
from fic_jax.engine.xla import in_blocks
from fic_jax.inputs import ParamsError, count, expect, on_host, shown
from fic_jax.lanes import Untranslatable, lane_map
from fic_jax.lanes.mapping import LaneMap
from fic_jax.lanes.sources import digest
from fic_jax.metrics import Metrics, Run, blank, run_by_intervals, run_by_steps
from fic_jax.params import QUANTITIES, Model, Params, check, check_model, check_step, of_one_type

Backend = Literal["auto", "lanes", "ptx", "xla", "pallas"]
# Steps of rk4 in one iteration of XLA's time loop: two are 1.2 times faster than one, more only
# take longer to compile.
UNROLL = 2

# The backends of a kind of device, the fastest first: `auto` uses the first one that works.
FASTEST: dict[str, tuple[Backend, ...]] = {"cpu": ("lanes", "xla"), "gpu": ("ptx", "pallas", "xla")}
SLOWER = {  # (device, backend) -> what a user gets and loses where it is not the first
    ("cpu", "xla"): "XLA compiles the sweep instead, expect half the speed; `pip install llvmlite` "
    "if it is missing",
    ("gpu", "pallas"): "Pallas compiles the sweep instead; `pip install 'fic-jax[gpu]'` if "
    "cuda.core or llvmlite is missing",
    ("gpu", "xla"): "XLA launches several kernels for each plant step instead, expect a hundredth "
    "of the speed; `pip install 'fic-jax[gpu]'` if cuda.core or llvmlite is missing",
}
STREAMS = 8  # of each GPU: parts that are copied or computed at the same time

# [N] quantities in the order of QUANTITIES, dt -> results with leaves [N]
Program = Callable[[Sequence[np.ndarray], np.ndarray], Any]


@overload
def sweep(
    batch: Params,
    *,
    model: Model = ...,
    dt: float,
    n_steps: int,
    error_estimate: Literal[False] = ...,
    backend: Backend = ...,
) -> Metrics: ...


@overload
def sweep(
    batch: Params,
    *,
    model: Model = ...,
    dt: float,
    n_steps: int,
    error_estimate: Literal[True],
    backend: Backend = ...,
) -> tuple[Metrics, Metrics]: ...


def sweep(
    batch: Params,
    *,
    model: Model = Model(),
    dt: float,
    n_steps: int,
    error_estimate: bool = False,
    backend: Backend = "auto",
) -> Metrics | tuple[Metrics, Metrics]:
    """Metrics of N scenarios over `n_steps` plant steps of `dt` seconds.

    Takes Params with [N] leaves (scalars broadcast); returns Metrics with NumPy leaves [N]. With
    `error_estimate` it returns two: the metrics and their estimated errors (`evaluate_with_error`),
    at several times the cost. JAX's promotion of the leaves gives the dtype.

    Inside `jax.jit` the leaves and `dt` may be traced, with the backends `lanes` and `ptx`: the
    batch can be computed on the device and the metrics reduced there. Traced values are not
    checked.

    All cores of a CPU (or as many as `tune_for_throughput` was given) or all local GPUs share the
    work. The bits of a scenario do not depend on N, on its neighbours or on this sharing.

    backend: `auto`, the fastest on this device, or one of
        `lanes` this package's compiler for the vector registers of a CPU (needs llvmlite)
        `ptx` this package's compiler for the threads of NVIDIA GPUs (needs llvmlite and cuda.core),
            with the bits that a CPU with fused multiply-adds has
        `xla` XLA, on any device
        `pallas` one kernel on a GPU; elsewhere interpreted, slowly

    Raises ParamsError if a value is out of bounds or leaves have different lengths. A backend that
    is chosen by name raises if it is not available; `auto` warns and uses the next one.
    """
    if backend not in get_args(Backend):
        raise ParamsError("backend", shown(backend), "one of " + ", ".join(get_args(Backend)))
    if not isinstance(error_estimate, bool):
        raise ParamsError("error_estimate", shown(error_estimate), "True or False")
    if _traced_by_jit(batch, dt):
        return _inside_jit(backend, batch, dt, model, n_steps, error_estimate)
    fields, h, n_steps = checked_fields(batch, model, dt, n_steps, instead="evaluate")
    with at_once() as traced:
        devices = tuple(jax.local_devices())
        on_gpu = backend == "auto" and devices[0].platform == "gpu"
        if traced and on_gpu and not _works("ptx", devices):
            backend = "xla"  # Pallas can't compile while JAX folds constants
        program = _program(backend, model, n_steps, error_estimate, h.dtype, devices)
        return program(columns(fields), h)


def _traced_by_jit(batch: Params, dt: Any) -> bool:
    """Whether `jax.jit` traces the batch or the step, and no other transformation does."""
    expect("batch", batch, Params, "Params(K0=[1.0, 10.0])")
    traced = [x for x in (*vars(batch).values(), dt) if isinstance(x, jax.core.Tracer)]
    return bool(traced) and all(isinstance(x, DynamicJaxprTracer) for x in traced)


def _inside_jit(
    backend: Backend, batch: Params, dt: Any, model: Model, n_steps: int, error_estimate: bool
) -> Any:
    """The metrics of a traced batch, as traced arrays. Raises ParamsError."""
    check_model(model)
    n_steps = count("n_steps", n_steps)
    check(batch, dt)  # of what is not traced
    p = of_one_type("batch", batch)
    h = jnp.asarray(dt, p.K0.dtype)
    leaves = {name: jnp.asarray(leaf) for name, leaf in vars(p).items()}
    n = length(leaves)
    with at_once():
        devices = tuple(jax.local_devices())
        here = "ptx" if devices[0].platform == "gpu" else "lanes"
        if backend not in ("auto", here):
            wanted = f"{here} where the batch is traced and JAX's device is a {devices[0].platform}"
            raise ParamsError("backend", backend, wanted)
        program = _program(backend, model, n_steps, error_estimate, h.dtype, devices)
    if not isinstance(program, LaneMap):  # `auto` has warned
        raise ParamsError("backend", backend, f"{here}, which is not available, in a traced batch")
    return program.inside_jit(
        [jnp.broadcast_to(leaf.reshape(-1), n) for leaf in leaves.values()], h
    )


@contextmanager
def at_once() -> Iterator[bool]:
    """Compile and run at once, whatever the caller traces or debugs; yields whether it traces."""
    with jax.transfer_guard_host_to_device("allow"):
        traced = isinstance(jnp.zeros(()), jax.core.Tracer)
    with jax.ensure_compile_time_eval() if traced else nullcontext(), jax.disable_jit(False):
        yield traced


def checked_fields(
    batch: Params, model: Model, dt: float, n_steps: int, instead: str
) -> tuple[dict[str, np.ndarray], np.ndarray, int]:
    """Fields of scalars or [N], plant step and number of steps, on the host and in one dtype.

    `instead` is the function that a message names to a caller who traces. Raises ParamsError.
    """
    check_model(model)
    expect("batch", batch, Params, "Params(K0=[1.0, 10.0])")
    for name, value in {**vars(batch), "dt": dt}.items():
        if isinstance(value, jax.core.Tracer):
            wanted = f"known outside of jit, vmap and grad (inside, use jax.vmap of {instead})"
            raise ParamsError(name, "traced", wanted)
    check_step(dt)
    p = of_one_type("batch", batch)
    fields = {name: np.asarray(on_host(leaf)) for name, leaf in vars(p).items()}
    length(fields)
    check(Params(**fields), dt)
    return fields, np.asarray(on_host(dt), p.K0.dtype), count("n_steps", n_steps)


def columns(fields: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Fields of scalars or [N] as columns [N]."""
    n = length(fields)
    return [np.broadcast_to(values.reshape(-1), n) for values in fields.values()]


def length(fields: Mapping[str, Any]) -> int:
    """N of fields that are scalars or [N]. Raises ParamsError."""
    lengths = {values.shape for values in fields.values() if values.shape not in ((), (1,))}
    shape, *others = lengths or {(1,)}
    if others or len(shape) > 1:
        shapes = {name: values.shape for name, values in fields.items() if values.ndim}
        raise ParamsError("batch", shapes, "scalars and [N] arrays of one length")
    return shape[0]


def arithmetic(backend: Backend = "auto") -> str:
    """The compiler and whether it fuses multiply-adds, e.g. "lanes fused": they decide last bits.

    It is the same for `ptx` and for `lanes` on a CPU that has fused multiply-adds.
    """
    if backend == "auto":
        devices = tuple(jax.local_devices())
        ways = FASTEST.get(devices[0].platform, ("xla",))
        backend = next(way for way in ways if _works(way, devices))
    if backend == "ptx":
        return "lanes fused"
    if backend == "lanes":
        from fic_jax.lanes.objects import fused

        return f"lanes {'fused' if fused() else 'unfused'}"
    # (1 + eps)(1 - eps) - 1 is -eps^2, or 0 if the product is rounded first
    eps = np.float32(2.0**-12)
    rest = jax.jit(lambda a, b, c: a * b + c)(1 + eps, 1 - eps, np.float32(-1.0))
    return f"{backend} {'fused' if rest != 0 else 'unfused'}"


def _works(way: Backend, devices: tuple[jax.Device, ...]) -> bool:
    """Whether a backend is installed; ptx, whether it can compile and run anything here."""
    if way != "ptx":
        return way != "lanes" or importlib.util.find_spec("llvmlite") is not None
    try:
        lane_map(lambda x: x + 1.0, gpus=cuda_ordinals(devices))(np.ones(1, np.float32))
    except Exception:  # what the driver, LLVM and cuda.core raise
        return False
    return True


@lru_cache
def _program(
    backend: Backend,
    model: Model,
    n_steps: int,
    error_estimate: bool,
    dtype: np.dtype,
    devices: tuple[jax.Device, ...],
) -> Program:
    """One program for these devices. If `auto` can't use the fastest backend, it warns."""
    platform = devices[0].platform
    ways = FASTEST.get(platform, ("xla",)) if backend == "auto" else (backend,)
    result = result_types(model, error_estimate, dtype)
    tried = []
    for way in ways:
        compiled = _by_lanes if way in ("lanes", "ptx") else _by_jax
        try:
            program = compiled(way, model, n_steps, error_estimate, result, dtype, devices)
        # the driver, LLVM, Pallas and Triton raise errors of any type
        except Exception as error:
            expected = way != "lanes" or isinstance(error, Untranslatable | ImportError)
            if way == ways[-1] or not expected:
                raise
            tried.append(f"{way} ({' '.join(f'{type(error).__name__}: {error}'.split())[:200]})")
            continue
        if tried:
            where = f"with jax {jax.__version__} on {devices[0].device_kind}"
            what = f"{' and '.join(tried)} {where} failed: {SLOWER[platform, way]}"
            warnings.warn(what, RuntimeWarning, stacklevel=3)
        return program
    raise AssertionError


def _by_lanes(
    backend: str,
    model: Model,
    n_steps: int,
    error_estimate: bool,
    result: Any,
    dtype: np.dtype,
    devices: Sequence[jax.Device],
) -> Program:
    """The lane compiler's program for a CPU or for GPUs, compiled."""
    sources = digest(Path(__file__).parent.parent)
    key = sources and f"{sources} {model} {n_steps} {error_estimate}"
    gpus: Sequence[int] = ()
    if backend == "ptx":
        try:
            gpus = cuda_ordinals(devices)
        except ImportError as error:
            wanted = "cuda.core (`pip install 'fic-jax[gpu]'`)"
            raise ImportError(f"the backend `ptx` needs {wanted}: {error}") from None
    mapped = lane_map(
        scenario(model, n_steps, error_estimate),
        threads=len(gpus) * STREAMS or threads(devices),
        gpus=gpus,
        key=key,
        result=result,
        likeness=None if gpus else likeness,
    )
    one = np.zeros(1, dtype)
    mapped.prepare([one] * len(QUANTITIES), one[0])
    return mapped


def cuda_ordinals(devices: Sequence[jax.Device]) -> list[int]:
    """The GPUs among JAX's devices; those that the driver has, if JAX uses none.

    Raises ImportError without cuda.core, its own error where there is no driver.
    """
    from cuda.core import Device

    if gpus := [d.local_hardware_id for d in devices if d.platform == "gpu"]:
        return gpus
    Device(0)  # raises
    return [device.device_id for device in Device.get_all_devices()]


def likeness(quantities: Sequence[np.ndarray], _: np.ndarray) -> np.ndarray:
    """An order in which scenarios that switch at the same times are neighbours.

    By damping ratio of the environment, by where the force profile gives Td, and by stiffness of
    the environment over that of the controller; the first two by octaves. Measured on random
    scenarios: 0.8 of the time of located switches, 0.93 of rk4's.
    """
    least = np.float32(1e-6)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        p = Params(*(np.asarray(q, np.float32) for q in quantities))
        damping = np.log2(p.Denv / np.sqrt(p.Kenv * p.I + least) + np.float32(1e-3))
        demand = np.log2(np.abs(p.Td) / (p.K0 * p.x0) + least)
        stiffness = p.Kenv / p.K0
    keys = np.broadcast_arrays(stiffness, np.floor(0.5 * demand), np.floor(damping))
    return np.lexsort(keys)


def _by_jax(
    backend: str,
    model: Model,
    n_steps: int,
    error_estimate: bool,
    result: Any,
    dtype: np.dtype,
    devices: Sequence[jax.Device],
) -> Program:
    """XLA's program or Pallas' kernel."""
    in_kernel = backend == "pallas"
    one = scenario(model, n_steps, error_estimate, 1 if in_kernel else UNROLL, in_kernel)
    if backend == "pallas" and devices[0].platform != "gpu":
        backend = "interpreted"
    return in_blocks(backend, one, len(QUANTITIES), result, dtype, devices)


def scenario(
    model: Model, n_steps: int, error_estimate: bool, unroll: int = 1, by_steps: bool = False
) -> Any:
    """The function of one scenario, from its column of quantities and dt to its result.

    `by_steps`: without a loop of unknown length, which a kernel of Pallas can't have for vectors.
    """

    def run(p: Params, model: Model, dt: jax.Array, n_steps: int, **companion: Any) -> Run:
        if by_steps or model.integrator == "rk4":
            return run_by_steps(p, model, dt, n_steps, **companion, unroll=unroll)
        return run_by_intervals(p, model, dt, n_steps, **companion)

    def of_column(column: Sequence[jax.Array], dt: jax.Array) -> Any:
        params = Params(**dict(zip(QUANTITIES, column, strict=True)))
        if error_estimate:
            return estimated(params, model, dt, n_steps, run)
        return run(params, model, dt, n_steps)[0]

    return of_column


def result_types(model: Model, error_estimate: bool, dtype: np.dtype) -> Any:
    """The types of one scenario's result, without tracing its time loop."""

    def blank_result(p: Params, dt: jax.Array) -> Any:
        metrics = blank(p, dt)
        return (
            (metrics, difference(metrics, metrics, metrics.finite, model))
            if error_estimate
            else metrics
        )

    scalar = jax.ShapeDtypeStruct((), dtype)
    return jax.eval_shape(blank_result, Params(**dict.fromkeys(QUANTITIES, scalar)), scalar)
