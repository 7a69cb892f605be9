"""PTX of a graph: its text, for every reading of the model and several GPUs; its registers."""

import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from sysconfig import get_paths

import jax
import llvmlite.binding as llvm
import numpy as np
import pytest

from fic_jax import Model
from fic_jax.engine import sweeping
from fic_jax.lanes.graph import live
from fic_jax.lanes.kernel import optimized
from fic_jax.lanes.threads import THREADS, ptx, thread_ir
from fic_jax.params import QUANTITIES
from tests.engine.bits import readings
from tests.lanes.programs import N_COLUMNS, program
from tests.lanes.ptx_machine import Program, fused, lesser, operation
from tests.torture import many

DTYPES = [np.dtype(np.float32), np.dtype(np.float64)]
READINGS = [(name, model, dtype) for name, model in readings() for dtype in DTYPES]
CHOSEN = READINGS[::73]  # 12 of 864
CAPABILITIES = [(7, 5), (8, 0), (8, 6), (9, 0)]


def emitted(function, types, dtype, capability=(9, 0)):
    """The graph's results and the PTX of a function of columns of these types."""
    results = jax.tree.leaves(jax.eval_shape(function, *types))
    roots = optimized(function, types, [False] * len(types), results, dtype)
    of_results = [np.dtype(one.dtype) for one in results]
    return roots, ptx(thread_ir(roots, dtype, [t.dtype for t in types], of_results), capability)


def of_model(model, dtype, n_steps=50):
    one = sweeping.scenario(model, n_steps, False)
    types = [jax.ShapeDtypeStruct((), dtype)] * (len(QUANTITIES) + 1)
    return emitted(lambda *args: one(args[:-1], args[-1]), types, dtype)


def assert_plain(roots, text):
    """One entry, no calls, no memory of its own, and no arithmetic but IEEE's."""
    assert text.count(".entry") == 1
    assert f".maxntid {THREADS}" in text
    for word in (
        "call",
        ".local",
        ".shared",
        ".extern",
        ".func",
        ".ftz",
        ".approx",
        ".full",
        ".sat",
    ):
        assert word not in text, word
    names = Program(text).instructions  # refuses what it does not know
    for name in names:
        if re.match(r"(add|sub|mul|div|rcp|sqrt|fma)\..*\.f\d\d$", name):
            assert name.split(".")[1] == "rn", name
    assert fused_products(names) <= fused_products_of(roots, names)  # LLVM shares equal ones


def fused_products(names):
    return sum(name.startswith("fma.rn") for name in names)


def fused_products_of(roots, names):
    """Those of the graph, and of the polynomial of each exponential."""
    operations = Counter(node.op for node in live(roots))
    of_exp = 8 if "fma.rn.f32" in names else 14
    return operations["fma"] + operations["exp"] * of_exp


@pytest.fixture(autouse=True)
def _one_iteration_at_a_time(monkeypatch):
    """So that the text has each operation of the graph once."""
    monkeypatch.setattr("fic_jax.lanes.threads.UNROLLED", 1)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_the_text_is_plain_ieee_arithmetic(dtype):
    scalar = jax.ShapeDtypeStruct((), dtype)
    for seed in range(many(10, 200)):
        assert_plain(*emitted(program(seed), [scalar] * (N_COLUMNS + 1), dtype))


@pytest.mark.parametrize("case", many(CHOSEN, READINGS), ids=lambda c: f"{c[0]} {c[2]}")
def test_every_reading_of_the_model_has_a_kernel(case):
    _, model, dtype = case
    assert_plain(*of_model(model, dtype))


def test_the_chosen_readings_have_both_types_and_every_law():
    assert {dtype for *_, dtype in CHOSEN} == set(DTYPES)
    assert {model.law for _, model, _ in CHOSEN} == {model.law for _, model, _ in READINGS}


@pytest.mark.parametrize("capability", CAPABILITIES)
def test_other_gpus(capability):
    scalar = jax.ShapeDtypeStruct((), np.float32)
    roots, text = emitted(program(1), [scalar] * (N_COLUMNS + 1), DTYPES[0], capability)
    assert_plain(roots, text)
    assert f".target sm_{capability[0]}{capability[1]}" in text


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_the_default_model_has_the_fused_products_of_its_graph(dtype):
    roots, text = of_model(Model(), dtype)
    names = Program(text).instructions
    assert fused_products(names) == fused_products_of(roots, names) > 0


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_only_the_graph_fuses_products(dtype):
    """A product with two users stays one; each fused one of the graph is one instruction."""
    scalar = jax.ShapeDtypeStruct((), dtype)
    functions = {
        "fma": lambda x, y, z: x * y + z,
        "mul add": lambda x, y, z: (x * y + z, x * y),
        "mul sub": lambda x, y, z: (x * y, z - x * y),
    }
    for names, function in functions.items():
        _, text = emitted(function, [scalar] * 3, dtype)
        of_floats = [n for n in Program(text).instructions if re.search(r"\.rn\.f\d\d$", n)]
        assert sorted(n.split(".")[0] for n in of_floats) == sorted(names.split())


def test_an_llvm_without_nvptx_is_an_error(monkeypatch):
    def from_triple(_):
        raise RuntimeError("No available targets are compatible with triple")

    monkeypatch.setattr(llvm.Target, "from_triple", from_triple)
    with pytest.raises(RuntimeError, match="No available targets"):
        emitted(lambda x: x, [jax.ShapeDtypeStruct((), np.float32)], DTYPES[0])


def assembler():
    """`ptxas`, on the path or from the package nvidia-cuda-nvcc."""
    packages = Path(get_paths()["purelib"]) / "nvidia"
    return shutil.which("ptxas") or next(map(str, packages.glob("*/bin/ptxas")), None)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("integrator", ["rk4", "rk4_events"])
def test_the_state_of_a_scenario_stays_in_registers(integrator, dtype, tmp_path):
    """Nothing is spilled: the assembler says so."""
    command = assembler()
    if command is None:
        pytest.skip("no ptxas on the path, nor the package nvidia-cuda-nvcc")
    file = tmp_path / "kernel.ptx"
    file.write_text(of_model(Model(integrator=integrator), dtype, 1000)[1])
    done = subprocess.run(
        [command, "-v", "-arch=sm_90", str(file), "-o", str(tmp_path / "kernel.cubin")],
        capture_output=True,
        text=True,
        check=True,
    )
    stack = "0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads"
    assert stack in done.stderr, done.stderr


# ---- The interpreter of the other tests ----------------------------------------------------------


def test_the_interpreter_rounds_a_fused_product_once():
    one, tiny = np.float32(1), np.float32(2.0**-24 * (1 + 2.0**-23))
    assert fused(one, tiny, one) == np.float32(1 + 2.0**-23)  # as a double it would be a tie
    x = np.float64(1 + 2.0**-52)
    assert fused(x, x, np.float64(-1)) == 2.0**-51 + 2.0**-104
    assert fused(np.float64(1e300), np.float64(-1e300), np.float64(1)) == -np.inf
    zero = np.float64(0.0)
    assert np.signbit(fused(-zero, np.float64(3), -zero))
    assert not np.signbit(fused(np.float64(2), np.float64(3), np.float64(-6)))
    smallest = np.float64(5e-324)
    assert fused(smallest, np.float64(0.5), zero) == 0.0
    assert fused(smallest, np.float64(0.75), zero) == smallest


def test_the_interpreter_orders_zeros_and_refuses_what_it_does_not_know():
    zero, nan = np.float32(0.0), np.float32(np.nan)
    assert np.signbit(lesser(zero, -zero)) and np.signbit(lesser(-zero, zero))
    assert lesser(nan, np.float32(1.0)) == lesser(np.float32(1.0), nan) == 1.0
    for name in ("add.rn.ftz.f32", "div.full.f32", "ex2.approx.f32", "fma.rz.f32", "vote.any.b32"):
        with pytest.raises((NotImplementedError, KeyError)):
            operation(name, 2)
    assert operation("cvt.rzi.s32.f32", 1)[0](np.float32(-3e9)) == 2**31
    assert operation("setp.ltu.f32", 2)[0](nan, zero) is True
    assert operation("setp.lt.f32", 2)[0](nan, zero) is False
