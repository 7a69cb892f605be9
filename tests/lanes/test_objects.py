"""Machine code: other processors, the stack, the compile cache."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import numpy as np
import pytest

from fic_jax.lanes import lane_map, where_rare
from tests.lanes.compiling import DTYPES, assert_same, text

ROOT = Path(__file__).parents[2]


def decaying(x, y):
    """A loop with a branch, comparisons, an exp and a conversion."""

    def body(i, s):
        x, n = s
        x = where_rare(x > y, lambda: x - jnp.exp(-jnp.abs(x)), x + 0.1)
        return x, n + jnp.floor(x).astype(jnp.int32)

    return jax.lax.fori_loop(0, 30, body, (x, (0.0 * x).astype(jnp.int32)))


@pytest.mark.parametrize(
    ("triple", "cpu", "lanes", "mask_bits"),
    [
        ("x86_64-unknown-linux-gnu", "x86-64", 8, 32),
        ("x86_64-unknown-linux-gnu", "haswell", 8, 32),
        ("x86_64-unknown-linux-gnu", "skylake-avx512", 16, 1),
        ("aarch64-unknown-linux-gnu", "neoverse-n1", 4, 32),
        ("arm64-apple-macosx", "apple-m1", 4, 32),
    ],
)
def test_other_processors_need_no_library_calls(triple, cpu, lanes, mask_bits):
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(triple).create_target_machine(cpu=cpu, opt=3)
    module = llvm.parse_assembly(text(decaying, 2, lanes, mask_bits, DTYPES[0]))
    module.verify()
    module.triple, module.data_layout = triple, str(machine.target_data)
    calls = machine.emit_assembly(module).count("call")
    assert calls == 0 or cpu == "x86-64"  # which has no instruction for floor


PROCESSORS = ["host", "no AVX-512", "no FMA", "SSE2"]


def without_instructions(processor, monkeypatch):
    """Hide instruction sets of this processor from LLVM."""
    if not llvm.get_process_triple().startswith("x86_64"):
        pytest.skip("the instruction sets named here are those of x86")
    hidden = {
        "no AVX-512": ("avx512", "avx10"),
        "no FMA": ("avx512", "avx10", "fma"),
        "SSE2": ("avx", "fma", "f16c", "xop", "vaes", "vpclmul", "sse3", "ssse", "sse4"),
    }.get(processor, ())
    features = [
        f"-{name[1:]}" if name[1:].startswith(hidden) and hidden else name
        for name in llvm.get_host_cpu_features().flatten().split(",")
    ]
    monkeypatch.setattr("fic_jax.lanes.objects.features", lambda: ",".join(features))


@pytest.mark.parametrize("processor", PROCESSORS)
def test_fewer_instruction_sets_give_the_same_results(processor, monkeypatch):
    """The same bits with fused multiply-adds; without, one rounding more a sum, 30 iterations."""
    x, y = np.linspace(-2.0, 2.0, 100), np.linspace(0.3, 1.0, 100)
    expected = lane_map(decaying)(x, y)
    without_instructions(processor, monkeypatch)
    got = lane_map(decaying)(x, y)
    if processor in ("host", "no AVX-512"):
        assert_same(got, expected)
    else:
        np.testing.assert_allclose(got[0], expected[0], rtol=1e-12)


def test_the_stack_is_aligned():
    """Otherwise spilled vectors lie across two cache lines, in some processes."""
    assert "alignstack(64)" in text(decaying, 2, 8, 64)


PRINTED = """
import hashlib, sys
import jax
from tests.lanes.compiling import text
from tests.lanes.programs import N_COLUMNS, program
jax.config.update("jax_enable_x64", True)
digest = hashlib.sha256()
for seed in range(12):
    digest.update(text(program(seed), N_COLUMNS + 1, 4, 64).encode())
sys.stdout.write(digest.hexdigest())
"""


def test_every_process_writes_the_same_text():
    texts = {
        subprocess.run(
            [sys.executable, "-c", f"x = [object() for _ in range({n})]\n{PRINTED}"],
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
        ).stdout
        for n in (1, 1000)
    }
    assert len(texts) == 1


@pytest.fixture
def cache(tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    return tmp_path


def test_a_key_caches_the_code_and_saves_the_trace(cache):
    traces = []

    def function(x):
        traces.append(1)
        return x + 1.0

    result = jax.ShapeDtypeStruct((), np.float64)
    for _ in range(2):
        got = lane_map(function, key="added", result=result)(np.ones(3))
        np.testing.assert_array_equal(got, 2.0)
    assert len(traces) == 1
    assert len(list(cache.iterdir())) == 1
    lane_map(function, key="other", result=result)(np.ones(3))
    lane_map(function, result=result)(np.ones(3))
    assert len(list(cache.iterdir())) == 2


def test_a_damaged_object_file_is_compiled_again(cache):
    lane_map(lambda x: x + 1.0, key="added")(np.ones(3))
    (file,) = cache.iterdir()
    intact = file.read_bytes()
    file.write_bytes(intact[:-1] + bytes([intact[-1] ^ 1]))
    np.testing.assert_array_equal(lane_map(lambda x: x + 1.0, key="added")(np.ones(3)), 2.0)
    assert file.read_bytes() == intact


@pytest.mark.parametrize("folder", ["file", "file/below"])
def test_a_cache_that_can_not_be_written_is_no_reason_not_to_run(folder, tmp_path):
    (tmp_path / "file").write_text("no folder")
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / folder))
    np.testing.assert_array_equal(lane_map(lambda x: x + 1.0, key="added")(np.ones(3)), 2.0)


def test_sources_that_changed_since_the_start_cache_nothing(cache, monkeypatch):
    monkeypatch.setattr("fic_jax.lanes.sources.LOADED", 0.0)
    lane_map(lambda x: x - 1.0, key="subtracted")(np.ones(4))
    assert not list(cache.iterdir())
