"""JAX's modes change no number: shard_map, guards, strict promotion, checkpoint, no jit, x64."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fic_jax import (
    Model,
    Params,
    control,
    energy,
    evaluate,
    evaluate_with_error,
    force,
    histories,
    init,
    rollout,
    step,
    sweep,
)

RUN = {"dt": 0.01, "n_steps": 4}
K0 = np.array([50.0, 100.0, 150.0, 200.0])
NAMES = ("evaluate", "errors", "rollout", "step", "control", "gradient", "force", "energy")


def functions(model):
    """Public functions as functions of K0, for the modes below."""

    def errors(K0):
        return evaluate_with_error(Params(K0=K0), model=model, **RUN)[1].nmse

    def steps(K0):
        p = Params(K0=K0)
        state, _ = step(p, init(p, model), model=model, dt=0.01)
        return step(p, state, model=model, dt=0.01)[0].x

    def controlled(K0):
        p = Params(K0=K0)
        tau, memory = control(p, init(p, model).memory, 0.0, 0.1, 1, model=model, dt=0.01)
        return tau + memory.e_M

    def nmse(K0):
        return evaluate(Params(K0=K0), model=model, **RUN).nmse

    return {
        "evaluate": nmse,
        "errors": errors,
        "rollout": lambda K0: rollout(Params(K0=K0), model=model, **RUN).x.sum(),
        "step": steps,
        "control": controlled,
        "gradient": jax.grad(nmse),
        "force": lambda K0: force(0.101, Params(K0=K0)),
        "energy": lambda K0: energy(0.101, Params(K0=K0)),
    }


def in_jit(function, values):
    return jax.jit(jax.vmap(function))(values)


def eagerly_under_a_guard(function, values):
    on_device = list(jax.device_put(values))
    with jax.transfer_guard("disallow"):
        return [function(k) for k in on_device]


def of_host_numbers_under_a_guard(function, values):
    with jax.transfer_guard("disallow"):
        return [function(float(k)) for k in values]


def in_jit_under_a_guard(function, values):
    on_device = jax.device_put(values)
    with jax.transfer_guard("disallow"):
        return in_jit(function, on_device)


def without_jit(function, values):
    with jax.disable_jit():
        return [function(k) for k in values]


def with_debug_nans(function, values):
    with jax.debug_nans(True):
        return [function(k) for k in values]


def with_checkpoint(function, values):
    return in_jit(jax.checkpoint(function), values)


def in_nested_jit(function, values):
    return jax.jit(jax.jit(jax.vmap(jax.jit(function))))(values)


MODES = {
    "vmap": lambda function, values: jax.vmap(function)(values),
    "map": jax.lax.map,
    "nested jit": in_nested_jit,
    "checkpoint": with_checkpoint,
    "guard, eager": eagerly_under_a_guard,
    "guard, host numbers": of_host_numbers_under_a_guard,
    "guard, jit": in_jit_under_a_guard,
    "no jit": without_jit,
    "debug_nans": with_debug_nans,
}
# they take long to compile; and JAX's own eager gradient moves a constant, which a guard forbids
LONG, FEW_MODES = ("errors", "gradient"), ("vmap", "checkpoint", "guard, jit")
CASES = [("rk4", m, n) for m in MODES for n in NAMES if n not in LONG or m in FEW_MODES]
# its pieces take long to compile; "errors" locates switches in all modes
CASES += [("rk4_events", m, n) for m in ("map", "debug_nans") for n in ("evaluate", "step")]


@pytest.fixture(scope="module")
def expected():
    """Values of the public functions, each compiled once."""
    known = {}

    def of(integrator, name):
        if (integrator, name) not in known:
            function = functions(Model(integrator=integrator))[name]
            known[integrator, name] = in_jit(function, K0)
        return known[integrator, name]

    return of


@pytest.mark.parametrize(("integrator", "mode", "name"), CASES)
def test_a_mode_changes_no_number(integrator, mode, name, expected):
    got = MODES[mode](functions(Model(integrator=integrator))[name], K0)
    np.testing.assert_allclose(np.asarray(got), expected(integrator, name), rtol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_integers_are_cast_like_floats_where_promotion_is_strict(name):
    """Of Python, of NumPy and of JAX; conftest.py makes promotion strict."""
    function = functions(Model())[name]
    expected = function(100.0)
    if name == "gradient":  # by Td, with an integer K0
        expected, integer = (
            jax.grad(lambda Td, k=k: evaluate(Params(K0=k, Td=Td), **RUN).nmse)(5.0)
            for k in (100.0, jnp.int32(100))
        )
        assert float(integer) == float(expected)
        return
    for integer in (100, np.int16(100), jnp.int32(100), np.array(100)):
        assert float(function(integer)) == float(expected)


@pytest.mark.parametrize("backend", ["lanes", "xla"])
@pytest.mark.parametrize(
    "mode",
    [
        lambda: jax.transfer_guard("disallow"),
        jax.disable_jit,
        lambda: jax.debug_nans(True),
    ],
    ids=["guard", "no jit", "debug_nans"],
)
def test_a_mode_changes_no_bit_of_a_sweep(backend, mode):
    batch = Params(K0=jax.device_put(K0))
    expected = sweep(batch, backend=backend, **RUN)
    signals = histories(batch, **RUN)
    with mode():
        got = sweep(batch, backend=backend, **RUN)
        assert histories(batch, **RUN).identical(signals)
    jax.tree.map(np.testing.assert_array_equal, got, expected)


@pytest.mark.parametrize("backend", ["lanes", "xla"])
def test_a_sweep_of_constants_runs_while_the_caller_traces(backend):
    expected = sweep(Params(K0=K0), backend=backend, **RUN).nmse

    @jax.jit
    def scaled(factor):
        histories(Params(K0=K0), **RUN)
        return factor * jnp.asarray(sweep(Params(K0=K0), backend=backend, **RUN).nmse)

    np.testing.assert_array_equal(scaled(1.0), expected)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16", "float8_e4m3fn"])
def test_low_precision_is_computed_in_single(dtype):
    low = jnp.asarray(100.0, dtype)  # exact, but in float8
    single = np.float32(low.astype(np.float32))
    p, run = Params(K0=low), {"dt": 0.01, "n_steps": 50}
    expected = evaluate(Params(K0=single), **run)
    for metrics in (evaluate(p, **run), jax.jit(lambda p: evaluate(p, **run))(p)):
        assert metrics.nmse.dtype == np.float32
        assert float(metrics.nmse) == float(expected.nmse)
    many = sweep(Params(K0=np.asarray(low)[None]), **run).nmse
    assert many.dtype == np.float32
    assert many[0] == pytest.approx(float(expected.nmse), rel=1e-5)
    state = jax.tree.map(
        lambda leaf: leaf.astype(dtype) if leaf.dtype.kind == "f" else leaf, init(p)
    )
    after, _ = step(p, state, dt=0.01)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(after)} == {"int32", "float32"}
    tau, _ = control(p, state.memory, low, low, low, dt=0.01)
    assert (tau.dtype, force(low, p).dtype, energy(low, p).dtype) == 3 * (np.float32,)


def test_force_is_compiled_once():
    """Eager `vmap` compiled at each call."""
    compiled = []

    def record(event, _, **details):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(details)

    e, p = np.linspace(-0.2, 0.2, 5), Params()
    jax.vmap(force, in_axes=(0, None))(e, p)
    jax.monitoring.register_event_duration_secs_listener(record)
    jax.vmap(force, in_axes=(0, None))(2.0 * e, p)
    assert compiled == []


DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
from fic_jax import Model
from tests.physics.test_modes import K0, NAMES, functions, in_jit

mesh = jax.make_mesh((2,), ("device",), axis_types=(AxisType.Auto,))
spec = P("device")
shards = jax.device_put(jnp.asarray(K0), NamedSharding(mesh, spec))


def sharded(body, K0, specs=spec):
    return jax.jit(jax.shard_map(body, mesh=mesh, in_specs=specs, out_specs=spec))(K0)


for integrator in ("rk4", "rk4_events"):
    for name in NAMES if integrator == "rk4" else ("step",):
        function = functions(Model(integrator=integrator))[name]
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-9, err_msg=name)
        expected = np.asarray(in_jit(function, K0))
        close(in_jit(function, shards), expected)
        close(sharded(jax.vmap(function), shards), expected)
        if (name, integrator) == ("evaluate", "rk4"):  # gradient by what all devices share
            def total(k):
                each = jax.vmap(lambda x, w: function(x * w), in_axes=(0, None))
                mean = lambda w: jax.lax.psum(each(k, w).sum(), "device")
                return jax.grad(mean)(1.0)[None]
            expected = jax.grad(lambda w: in_jit(function, w * jnp.asarray(K0)).sum())(1.0)
            close(sharded(total, shards), [expected, expected])
print("done")
"""


def test_shards_of_two_devices_give_the_same_numbers():
    """In float32: inputs that are sharded, and `shard_map` with its check."""
    flags = "--xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", DEVICES],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "done\n", done.stderr
