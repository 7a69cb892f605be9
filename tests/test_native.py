"""The kernel of a CPU: its operations against numpy's, its branches against none, its fall-back."""

import os
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import numpy as np
import pytest

from fic_jax import METRICS, Model, Params, engine, sweep
from fic_jax import lanes as native
from fic_jax.lanes import Kernel
from fic_jax.lanes.branches import branch_out
from fic_jax.lanes.graph import Branch, Loop, Untranslatable, live
from fic_jax.lanes.rounding import fuse
from fic_jax.lanes.tracing import traced
from fic_jax.lanes.turns import recall
from fic_jax.lanes.vectors import kernel
from fic_jax.params import QUANTITIES
from tests.programs import N_COLUMNS, N_RESULTS, program
from tests.store import faults

ROOT = Path(__file__).parent.parent
PROGRAMS = 1000 if os.environ.get(faults.TORTURE) else 40
DTYPES = [np.dtype(np.float32), np.dtype(np.float64)]
ODD = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 3.0, 7.25, 1e-30, -1e-30, 1e30, np.inf, -np.inf, np.nan]
# every option at least once
MODELS = [
    Model(),
    Model("effort", "error_rate", "running", "motor", "damped_rebound", "rk4_events"),
    Model("energy", "velocity_band", "latched", "interaction", "welded", "rk4_events"),
    Model("algorithm1", "error_rate", "running", "interaction", "hard_stop", "rk4"),
]


@pytest.fixture(autouse=True)
def nothing_kept():
    """Kernels are compiled anew: what a test changes is in no kernel's name."""
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", folder)


def computed(run, dtype, *columns, dt=0.25):
    """Results of `run` for columns, padded to whole vectors."""
    n_results = len(jax.tree.leaves(jax.eval_shape(run, *shapes(len(columns), dtype))))
    made = Kernel(run, len(columns), n_results, dtype, 1, "a test's own")
    n = len(columns[0])
    whole = np.zeros((len(columns), -(-n // made.lanes) * made.lanes), dtype)
    for row, column in zip(whole, columns, strict=True):
        row[:n] = column
    return made(whole, dt)[:, :n]


def shapes(n, dtype):
    scalar = jax.ShapeDtypeStruct((), dtype)
    return [scalar] * n, scalar


def pairs(dtype):
    """Every pair of odd numbers."""
    x, y = np.meshgrid(np.array(ODD, dtype), np.array(ODD, dtype))
    return x.ravel(), y.ravel()


def ones(condition, x):
    return condition.astype(x.dtype)


NUMBERS = {
    "insert": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "neg": lambda x, y: -x,
    "abs": lambda x, y: abs(x),
    "sign": lambda x, y: jnp.sign(x),
    "max": jnp.maximum,
    "min": jnp.minimum,
    "floor": lambda x, y: jnp.floor(x),
    "ceil": lambda x, y: jnp.ceil(x),
    "sqrt": lambda x, y: jnp.sqrt(x),
    "square": lambda x, y: jnp.square(x),
    "power": lambda x, y: x**2,
    "cube": lambda x, y: x**3,
    "where": lambda x, y: jnp.where(x < y, x, y),
    "or zero": lambda x, y: jnp.where(x < y, x, 0.0),
    "zero or": lambda x, y: jnp.where(x < y, 0.0, x),
    "or minus zero": lambda x, y: 1.0 / jnp.where(x < y, x, -0.0),  # which zero, infinity tells
    "minus zero or": lambda x, y: 1.0 / jnp.where(x < y, -0.0, x),
    "or none": lambda x, y: jnp.where(x < y, 2 * (x > 0).astype(jnp.int32), 0).astype(x.dtype),
    "or not": lambda x, y: ones(jnp.where(x < y, x > 0, False), x),
    "le": lambda x, y: ones(x <= y, x),
    "ge": lambda x, y: ones(x >= y, x),
    "eq": lambda x, y: ones(x == y, x),
    "ne": lambda x, y: ones(x != y, x),
    "finite": lambda x, y: jnp.where(jnp.isfinite(x), x, 5.0),
    "and": lambda x, y: ((x > 0) & (y > 0)).astype(x.dtype),
    "or": lambda x, y: ((x > 0) | ~(y > 0)).astype(x.dtype),
    "xor": lambda x, y: ((x > 0) ^ (y > 0)).astype(x.dtype),
    "counted": lambda x, y: ((x > 0).astype(jnp.int32) - (y > 0).astype(jnp.int32)).astype(x.dtype),
    "integers": lambda x, y: jnp.maximum(
        (x > 0).astype(jnp.int32), 3 * (y > 0).astype(jnp.int32)
    ).astype(x.dtype),
    "bools": lambda x, y: ((x > 0) > (y > 0)).astype(x.dtype),
    "no bools": lambda x, y: jnp.minimum(x > 0, y > 0).astype(x.dtype),
    "some": lambda x, y: jnp.where(x.astype(bool), x, 7.0),
    "clipped": lambda x, y: jnp.clip(x, -2.0, 2.0),
}


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_operations_are_ieee_with_every_pair_of_odd_numbers(dtype):
    x, y = pairs(dtype)
    found = computed(lambda c, dt: [of(*c) for of in NUMBERS.values()], dtype, x, y)
    for got, (name, of) in zip(found, NUMBERS.items(), strict=True):
        with np.errstate(all="ignore"):
            expected = np.asarray(jax.jit(of)(x, y))
        assert expected.dtype == dtype
        np.testing.assert_array_equal(got, expected, err_msg=name)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_whole_numbers_and_conditions_come_as_integers_of_the_numbers_width(dtype):
    x = np.array([-2.5, -1.0, 0.0, 1.0, 2.5, 7.0], dtype)
    found = computed(lambda c, dt: [c[0].astype(jnp.int32), c[0] > 1.0], dtype, x)
    whole = found.view(f"i{dtype.itemsize}")
    np.testing.assert_array_equal(whole[0], [-2, -1, 0, 1, 2, 7])
    beyond = np.array([np.nan, 1e30, -1e30], dtype)
    (ends,) = computed(lambda c, dt: [c[0].astype(jnp.int32)], dtype, beyond)
    limits = np.iinfo(f"i{dtype.itemsize}")
    np.testing.assert_array_equal(ends.view(f"i{dtype.itemsize}"), [0, limits.max, limits.min])
    np.testing.assert_array_equal(whole[1].astype(bool), x > 1.0)


@pytest.mark.parametrize(
    ("dtype", "least", "most"), [(DTYPES[0], -87, 88.72), (DTYPES[1], -708, 709.78)]
)
def test_exponentials_are_right_to_two_units_of_the_last_place(dtype, least, most):
    x = np.random.default_rng(0).uniform(least, most, 100_000).astype(dtype)
    (got,) = computed(lambda c, dt: [jnp.exp(c[0])], dtype, x)
    expected = np.exp(x.astype(np.longdouble))
    error = np.abs(got - expected) / np.spacing(expected.astype(dtype))
    assert error.max() < 2.0
    ends = np.array([0.0, -0.0, -1e4, 1e4, -np.inf, np.inf, np.nan, np.nan], dtype)
    ends.view(f"i{dtype.itemsize}")[-1] += 1  # a NaN with something in its last bits
    (got,) = computed(lambda c, dt: [jnp.exp(c[0])], dtype, ends)
    np.testing.assert_array_equal(got, [1.0, 1.0, 0.0, np.inf, 0.0, np.inf, np.nan, np.nan])


LOOPS = {
    "swapped": lambda c, dt: jax.lax.fori_loop(0, 5, lambda i, s: (s[1], s[0]), (c[0], c[1])),
    "unchanged": lambda c, dt: jax.lax.fori_loop(0, 5, lambda i, s: s, (c[0], c[1])),
    # a carry that starts the same for all scenarios, and does not stay so
    "uniform": lambda c, dt: jax.lax.fori_loop(
        0, 4, lambda i, s: (s[1], s[1] + c[0], dt), 3 * (dt,)
    ),
    "counted": lambda c, dt: jax.lax.fori_loop(
        0,
        7,
        lambda i, s: (s[0] + i.astype(float) * c[0], jnp.where(i == 3, c[1], s[1])),
        (c[0], c[1]),
    ),
    "nested": lambda c, dt: jax.lax.fori_loop(
        0,
        3,
        lambda i, s: jax.lax.fori_loop(0, 2, lambda j, t: (t[0] + c[1], t[1] * 0.5), s),
        (c[0], c[1]),
    ),
    "two": lambda c, dt: jax.lax.fori_loop(
        0,
        3,
        lambda i, s: (s[0] * 2.0, s[1] + s[0]),
        jax.lax.fori_loop(0, 2, lambda i, s: (s[0] + dt, s[1] - dt), (c[0], c[1])),
    ),
    # latched values of which something costly is computed, from a start that isn't 0
    "latched": lambda c, dt: jax.lax.fori_loop(
        0,
        9,
        lambda i, s: (
            jnp.where(s[1] > 0.0, s[1], s[0]),
            jnp.exp(-jnp.abs(jnp.where(s[1] > 0.0, s[1], s[0]))) - s[1],
        ),
        (c[0], c[1]),
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_loops_are_what_jax_makes_of_them(name):
    """Exact where nothing rounds, else to what one rounding in place of two can make."""
    x, y = np.linspace(-3.0, 4.0, 40), np.linspace(2.0, -2.0, 40)
    found = computed(LOOPS[name], np.dtype(float), x, y, dt=0.25)
    expected = jax.vmap(LOOPS[name], in_axes=(0, None))([jnp.asarray(x), jnp.asarray(y)], 0.25)
    for got, want in zip(found, expected, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-15)


def test_a_product_and_the_sum_it_is_only_used_in_are_rounded_once():
    x = np.array([1.0 + 2.0**-20] * 8, np.float32)
    y = np.array([1.0 - 2.0**-20] * 8, np.float32)
    found = computed(lambda c, dt: [c[0] * c[1] - 1.0], np.dtype(np.float32), x, y)
    exact, rounded = -(2.0**-40), 0.0
    fused = llvm.get_host_cpu_features().get("fma", True)  # ARM has it without a word
    np.testing.assert_array_equal(found[0], exact if fused else rounded)
    twice = computed(lambda c, dt: [c[0] * c[1] - 1.0, c[0] * c[1]], np.dtype(np.float32), x, y)
    np.testing.assert_array_equal(twice[0], rounded)


@pytest.mark.parametrize(
    ("run", "told"),
    [
        (lambda c, dt: [jnp.sin(c[0])], "the operation sin"),
        (lambda c, dt: [c[0] ** 5], "the power 5"),
        (lambda c, dt: [jnp.sign((c[0] > 0).astype(jnp.int32))], "the operation sign on"),
        (lambda c, dt: [jax.lax.select_n((c[0] > 0).astype(jnp.int32), *c, *c)], "select_n"),
        (lambda c, dt: [c[0].astype(jnp.int8)], "int8 among"),
        (lambda c, dt: [jax.lax.scan(lambda s, x: (s, s), c[0], length=3)[0]], "over arrays"),
        (lambda c, dt: [jnp.stack(c).sum()], "the operation|array"),
        (lambda c, dt: [jax.lax.while_loop(lambda s: s < 1, lambda s: s + 1, c[0])], "while"),
    ],
)
def test_what_has_no_translation_is_named(run, told):
    with pytest.raises(Untranslatable, match=told):
        computed(run, np.dtype(np.float32), np.ones(8, np.float32))


def test_numbers_of_other_types_have_none():
    with pytest.raises(Untranslatable, match="numbers of type float16"):
        Kernel(lambda c, dt: [c[0] + dt], 1, 1, np.dtype(np.float16), 1, "")
    with pytest.raises(Untranslatable, match="float64 among float32"):
        Kernel(lambda c, dt: [c[0].astype(float)], 1, 1, np.dtype(np.float32), 1, "")


# ---- What the last turn left ---------------------------------------------------------------------


def left(x, k):
    return 1.9 * jnp.exp(-k * x * x)


def turns(start, joined=jnp.maximum, held=jnp.copy):
    """A loop whose turn begins by computing what the last one has left, if it did so at first."""

    def turn(_, s):
        x = joined(0.5 * s[0], left(s[0], s[1]))
        return x, held(s[1]), left(x, s[1])

    return lambda c, dt: jax.lax.fori_loop(0, 4, turn, (c[0], c[1], start(c[0], c[1])))


def loop_of(nodes):
    (loop,) = {n.of for n in nodes if isinstance(n.of, Loop)}
    return loop


def computed_with_and_without_recall(run, monkeypatch):
    x, k = np.linspace(-2.0, 2.0, 40), np.linspace(0.1, 0.5, 40)
    found = computed(run, np.dtype(float), x, k)
    monkeypatch.setattr(native, "recall", lambda graph, roots: None)
    return found, computed(run, np.dtype(float), x, k)


# A copy is a value that the loop hands itself; without one, JAX takes it out of what is carried.
@pytest.mark.parametrize("held", [jnp.copy, lambda k: k], ids=["carried", "around"])
@pytest.mark.parametrize(
    ("joined", "units"),
    # A product that is kept is rounded. In a sum that alone uses it, it would not be: one rounding
    # less in each of four turns, each of which at most doubles what the last one was off.
    [(jnp.maximum, 0), (jnp.add, 16)],
    ids=["bit for bit", "to rounding"],
)
def test_a_turn_takes_what_the_last_one_left(joined, units, held, monkeypatch):
    run = turns(left, joined, held)
    graph, roots = traced(run, 2, np.dtype(float))
    loop = loop_of(live(roots))
    assert any(phi is out for phi, out in zip(loop.phis, loop.outs, strict=True)) == (
        held is jnp.copy
    )
    recall(graph, roots)
    assert [n.scope for n in live(roots) if n.op == "exp"].count(loop) == 1
    found, anew = computed_with_and_without_recall(run, monkeypatch)
    np.testing.assert_allclose(found, anew, rtol=units * np.finfo(float).eps, atol=0.0)


@pytest.mark.parametrize(
    "start",
    [
        lambda x, k: 3.0 * jnp.exp(-k * x * x),
        lambda x, k: left(k, x),
        lambda x, k: left(x, x),
        lambda x, k: x,
    ],
    ids=["another number", "swapped", "another operand", "no operation"],
)
def test_a_turn_takes_nothing_that_was_not_so_at_first(start, monkeypatch):
    graph, roots = traced(turns(start), 2, np.dtype(float))
    recall(graph, roots)
    nodes = live(roots)
    assert [n.scope for n in nodes if n.op == "exp"].count(loop_of(nodes)) == 2
    assert_same(*computed_with_and_without_recall(turns(start), monkeypatch))


# ---- Any program ---------------------------------------------------------------------------------


@pytest.mark.parametrize("first", range(0, PROGRAMS, 10))
def test_branches_change_no_bit_of_any_program(first, monkeypatch):
    """Two scenarios to a vector, so that branches are often jumped over."""
    monkeypatch.setattr(native, "register_bytes", lambda: 16)
    rng = np.random.default_rng(first)
    columns = rng.normal(scale=2.0, size=(N_COLUMNS, 128))
    columns[rng.random(columns.shape) < 0.2] = rng.choice(ODD)
    jump = native.branch_out
    for seed in range(first, first + 10):
        found = []
        for branched in (jump, lambda graph, roots: None):
            monkeypatch.setattr(native, "branch_out", branched)
            made = Kernel(program(seed), N_COLUMNS, N_RESULTS, np.dtype(float), 1, "")
            found.append(made(columns, 0.25))
        assert_same(*found)


# What once went wrong: equal arms, a feeder with other users, copies that nobody uses, conditions
# that are never met, a way from one exponential to another through a loop.
ONCE = {
    "equal arms": lambda c, dt: [
        jax.lax.fori_loop(0, 2, lambda _, s: jnp.where(c[0] > 0, jnp.exp(s), jnp.exp(s)), c[1])
    ],
    "feeder": lambda c, dt: jax.lax.fori_loop(0, 9, fed, (c[0], c[1])),
    "never": lambda c, dt: jax.lax.fori_loop(0, 5, lambda _, s: nested(s, c[0] > dt), (c[0], c[1])),
    "through a loop": lambda c, dt: [
        jax.lax.fori_loop(0, 3, lambda _, s: through(s, c[0] > 0, c[1]), c[0])
    ],
}


def fed(_, s):
    latch = jnp.where(s[1] > 0, s[1], s[0])
    y = -jnp.abs(latch)
    return latch, jnp.exp(y) * y - s[1]


def nested(s, condition):
    latch = jnp.where(s[1] > 0, s[1], s[0])
    inner = jnp.where(condition, s[1] - 1, jnp.exp(latch))
    return latch, jnp.where(condition, inner, s[1])


def through(s, condition, start):
    p = jnp.where(condition, jnp.exp(s), start)
    k = jax.lax.fori_loop(0, 5, lambda _, n: n * 0.5 + p, start)
    return jnp.where(condition, jnp.exp(k), s)


@pytest.mark.parametrize("name", ONCE)
def test_branches_change_no_bit_of_what_once_went_wrong(name, monkeypatch):
    x, y = np.linspace(-3.0, 3.0, 48), np.linspace(0.5, -1.5, 48)
    found = [computed(ONCE[name], np.dtype(float), x, y)]
    monkeypatch.setattr(native, "branch_out", lambda graph, roots: None)
    found.append(computed(ONCE[name], np.dtype(float), x, y))
    assert_same(*found)


WRITTEN = """
import hashlib, sys
import jax
import numpy as np
from fic_jax.lanes.branches import branch_out
from fic_jax.lanes.rounding import fuse
from fic_jax.lanes.tracing import traced
from fic_jax.lanes.turns import recall
from fic_jax.lanes.vectors import kernel
from tests.programs import N_COLUMNS, program
jax.config.update("jax_enable_x64", True)
told = hashlib.sha256()
for seed in range(12):
    graph, roots = traced(program(seed), N_COLUMNS, np.dtype(float))
    recall(graph, roots)
    fuse(graph, roots)
    branch_out(graph, roots)
    told.update(kernel(roots, N_COLUMNS, np.dtype(float), 4).encode())
sys.stdout.write(told.hexdigest())
"""


def test_every_process_writes_the_same():
    told = {
        subprocess.run(
            [sys.executable, "-c", f"x = [object() for _ in range({n})]\n{WRITTEN}"],
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
        ).stdout
        for n in (1, 1000)
    }
    assert len(told) == 1


def test_sources_that_changed_since_are_not_kept(tmp_path, monkeypatch):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    computed(lambda c, dt: [c[0] + dt], np.dtype(float), np.ones(4))
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(native.code, "LOADED", 0.0)
    computed(lambda c, dt: [c[0] - dt], np.dtype(float), np.ones(4))
    assert len(list(tmp_path.iterdir())) == 1


# ---- The law -------------------------------------------------------------------------------------


def batch(n, dtype, seed=0):
    """Scenarios over wide ranges, the last of them with a stiffness that diverges."""
    rng = np.random.default_rng(seed)
    columns = {
        "K0": np.exp(rng.uniform(0.0, 7.0, n)),
        "Kenv": np.exp(rng.uniform(2.0, 7.0, n)),
        "Denv": np.exp(rng.uniform(0.0, 7.0, n)),
        "Td": rng.uniform(-20.0, 20.0, n),
        "S": rng.uniform(1.0, 30.0, n),
        "gap": rng.choice([0.0, 0.02], n),
        "period": rng.choice([0.01, 0.03], n),
        "v_init": rng.choice([0.0, 0.5], n),
    }
    columns["Kenv"][-1] = 1e9
    return Params(**{k: v.astype(dtype) for k, v in columns.items()})


def assert_same(a, b):
    """Bit for bit, the sign of zero too, but for that of NaN."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(np.signbit(x[x == 0]), np.signbit(y[x == 0]))


@pytest.mark.parametrize(
    ("model", "dtype"), list(zip(MODELS, (*DTYPES, *DTYPES), strict=True)), ids=str
)
def test_branches_change_no_bit(arranged, model, dtype, monkeypatch):
    scenarios = batch(500, dtype)
    arranged("native")
    jumping = sweep(scenarios, model=model, dt=0.01, n_steps=120)
    monkeypatch.setattr(native, "branch_out", lambda graph, roots: None)
    arranged("native")
    assert_same(sweep(scenarios, model=model, dt=0.01, n_steps=120), jumping)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_the_kernel_agrees_with_the_scan_to_rounding(arranged, model):
    """Both follow the same traced function; 60 steps are too few for a rounding to grow."""
    scenarios = replace(batch(300, float, seed=1), Kenv=np.full(300, 200.0))
    estimate, found = model == MODELS[-1], []  # which is what takes XLA long
    for arrangement in ("native", "scan"):
        arranged(arrangement)
        metrics = sweep(scenarios, model=model, dt=0.01, n_steps=60, error_estimate=estimate)
        found.append(metrics if estimate else (metrics,))
    for mine, theirs in zip(*found, strict=True):
        for name in METRICS:
            got, expected = getattr(mine, name), getattr(theirs, name)
            assert got.dtype == expected.dtype
            # one scenario in a hundred stands on a switch to rounding
            close = np.isclose(got, expected, rtol=1e-7, atol=1e-9, equal_nan=True)
            assert np.mean(close) > 0.98, name


def test_no_torque_at_all_has_a_peak_of_zero_without_sign():
    nothing = Params(Kenv=np.zeros(3), Denv=0.0, Td=-1.0)
    peak = sweep(nothing, model=Model(contact="welded"), dt=0.01, n_steps=20).peak_torque
    assert not peak.any()
    assert not np.signbit(peak).any()


def branched(model=Model()):
    """What the results of a scenario's kernel are written from."""
    graph, roots = traced(engine._scenario(model, 50, False, 1), len(QUANTITIES), DTYPES[0])
    recall(graph, roots)
    fuse(graph, roots)
    branch_out(graph, roots)
    return roots


def test_the_default_law_jumps_over_its_exponentials():
    """One branch for the slopes of a latched peak, one for each of RK4's stages."""
    nodes = live(branched())
    loop = loop_of(nodes)
    found = {n.of for n in nodes if isinstance(n.of, Branch) and n.of.outer is loop}
    assert len(found) == 5
    assert not [n for n in nodes if n.op in ("exp", "div") and n.scope is loop]


@pytest.mark.parametrize("model", [Model(), Model(integrator="rk4_events")], ids=str)
def test_no_scope_of_the_law_computes_anything_twice(model):
    nodes = [n for n in live(branched(model)) if n.args]
    told = {(n.scope, n.op, n.args, n.kind, repr(n.value)) for n in nodes}
    assert len(told) == len(nodes)


def test_the_exponential_at_the_start_of_a_step_waits_for_all_that_is_known():
    """What the point ahead says of it is known later: for that, it is copied.

    One for both would only wait for the branch of Algorithm 1.
    """
    nodes = live(branched(Model(integrator="rk4_events")))
    names = list(QUANTITIES)
    given = {names[n.value]: n for n in nodes if n.op == "input" and n.value < len(names)}
    x0, xb = given["x0"], given["xb"]
    (diverging,) = (n for n in nodes if n.op == "le" and at_start(n.args[0]))
    error = diverging.args[0].args[0]
    products = [
        [condition.args for condition, _ in product]
        for n in nodes
        if n.op == "exp" and measured(n) is error
        for product in n.scope.demand
    ]
    for compared in products:
        assert {x0, xb} <= {args[-1] for args in compared}
    (size,) = (n for n in nodes if n.op == "abs" and n.args[0] is error)
    assert any({(size, x0), (size, xb)} <= set(compared) for compared in products)


def at_start(node):
    """Whether a node is the error times the velocity, both as the step finds them."""
    return node.op == "mul" and node.args[0].op == "sub" and node.args[1].op == "phi"


def measured(node):
    """What the size is of that an exponential depends on most directly."""
    waiting = [node]
    for nearest in waiting:
        if nearest.op == "abs":
            return nearest.args[0]
        waiting += [nearest.of.outs[nearest.value]] if nearest.op == "result" else nearest.args
    return None


def test_a_kernel_aligns_its_stack():
    """Or values that wait in memory lie across two lines of the cache, in some processes."""
    assert "alignstack(64)" in kernel(branched(), len(QUANTITIES), DTYPES[0], 8)


@pytest.mark.parametrize(
    ("triple", "cpu", "lanes"),
    [
        ("x86_64-unknown-linux-gnu", "x86-64", 8),
        ("x86_64-unknown-linux-gnu", "skylake-avx512", 32),
        ("aarch64-unknown-linux-gnu", "neoverse-n1", 8),
        ("arm64-apple-macosx", "apple-m1", 4),
    ],
)
def test_other_processors_have_instructions_for_it(triple, cpu, lanes):
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(triple).create_target_machine(cpu=cpu, opt=3)
    module = llvm.parse_assembly(kernel(branched(), len(QUANTITIES), DTYPES[0], lanes))
    module.verify()
    module.triple, module.data_layout = triple, str(machine.target_data)
    calls = machine.emit_assembly(module).count("call")
    assert calls == 0 or cpu == "x86-64"  # which has no instruction to round down


def test_a_processor_without_wide_vectors_agrees_to_rounding(arranged, monkeypatch):
    """SSE2, without fused products, run here."""
    if not llvm.get_process_triple().startswith("x86_64"):
        pytest.skip("the base of x86")
    scenarios = replace(batch(100, float, seed=2), Kenv=np.full(100, 200.0))
    arranged("native")
    ours = sweep(scenarios, dt=0.01, n_steps=60)
    target = llvm.Target.from_default_triple()
    base = target.create_target_machine(cpu="x86-64", opt=3, jit=True)
    monkeypatch.setattr(native, "this_processor", lambda: base)
    monkeypatch.setattr(native, "register_bytes", lambda: 16)
    arranged("native")
    theirs = sweep(scenarios, dt=0.01, n_steps=60)
    close = np.isclose(ours.nmse, theirs.nmse, rtol=1e-9)
    assert np.mean(close) > 0.98
    assert not np.array_equal(ours.nmse, theirs.nmse)


@pytest.mark.parametrize("missing", [True, False])
def test_without_llvm_xla_compiles_and_one_warning_says_so(arranged, missing, monkeypatch):
    scenarios = batch(10, np.float32)
    arranged("scan")
    expected = sweep(scenarios, dt=0.01, n_steps=20)
    if missing:
        for name in [
            name for name in sys.modules if name.startswith(("llvmlite", "fic_jax.lanes"))
        ]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, "llvmlite", None)
    else:
        monkeypatch.setattr(native, "this_processor", lambda: 1 / 0)
    arranged("native")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = [sweep(scenarios, dt=0.01, n_steps=20) for _ in range(2)]
    (message,) = [str(w.message) for w in told]
    assert message.startswith("no vector kernel with jax")
    assert ("pip install llvmlite" in message) and (not missing or "llvmlite" in message[:90])
    for metrics in found:
        assert_same(metrics, expected)
