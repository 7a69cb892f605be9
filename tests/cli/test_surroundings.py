"""Streams, locale and variables of other programs end no command; a wrong one is named."""

import os
import re
import subprocess

import pytest

from tests.cli.conftest import TINY
from tests.command import FIC_SWEEP, call

ASCII = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}


def in_shell(line, folder, **variables):
    """Run a line of bash, in which `fic-sweep` is ours."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment["PATH"] = f"{os.path.dirname(FIC_SWEEP)}:{environment['PATH']}"
    environment |= {"PYTHONPATH": os.environ.get("PYTHONPATH", "")} | variables
    return subprocess.run(
        ["bash", "-c", line], cwd=folder, env=environment, capture_output=True, check=False
    )


def test_any_locale_prints_any_letter(folder):
    """`show` ended in a traceback; the name of a file keeps its bytes, so it can be pasted."""
    (folder / "größe.toml").write_text(f'description = "µ → ∞"{TINY}', encoding="utf-8")
    shown = in_shell("fic-sweep show größe.toml", folder, **ASCII)
    assert (shown.returncode, shown.stderr) == (0, b"")
    assert rb'description = "\xb5 \u2192 \u221e"' in shown.stdout
    for line in ("run größe.toml --out größe.zarr", "status größe.zarr", "verify größe.zarr"):
        ended = in_shell(f"fic-sweep {line}", folder, **ASCII)
        assert (ended.returncode, ended.stderr) == (0, b"")
        assert ended.stdout.startswith("größe.zarr: ".encode())


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_closed_stream_ends_no_run(folder, closed):
    """The next file opened would get the number of the stream, and what a library prints."""
    ended = in_shell(f"fic-sweep run tiny.toml {closed} && fic-sweep verify tiny.zarr", folder)
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert ended.stdout.endswith(b"all as written\n")


def test_a_full_stdout_ends_no_run_and_gives_exit_code_1(folder):
    ended = in_shell("fic-sweep run tiny.toml > /dev/full", folder)
    assert (ended.returncode, ended.stderr) == (1, b"fic-sweep: stdout: No space left on device\n")
    assert b"12 of 12 cells" in in_shell("fic-sweep status tiny.zarr", folder).stdout


@pytest.mark.parametrize(
    "variables",
    [
        {"PYTHONWARNINGS": "error"},
        {"PYTHONOPTIMIZE": "2"},
        {"TERM": "", "COLUMNS": "0", "NO_COLOR": "1"},
        {"ZARR_DEFAULT_ZARR_FORMAT": "2", "ZARR_ARRAY__WRITE_EMPTY_CHUNKS": "maybe"},
        {"GIT_DIR": "/nowhere", "TMPDIR": "/nowhere", "OMP_NUM_THREADS": "many"},
        {"HOME": "/nowhere", "XDG_CACHE_HOME": "~/here"},
        {"MPLBACKEND": "module://of_a_notebook"},
    ],
    ids=lambda variables: next(iter(variables)),
)
def test_variables_of_other_programs_end_no_command(folder, variables):
    commands = ("run tiny.toml", "status tiny.zarr", "plot tiny.zarr --x Td --y K0")
    ended = in_shell(" && ".join(f"fic-sweep {c}" for c in commands), folder, **variables)
    assert (ended.returncode, ended.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("JAX_PLATFORMS", "cuda", "finds no such device here; unset the variable, or change it"),
        ("JAX_PLATFORMS", "bogus", "finds no such device here; unset the variable, or change it"),
        ("JAX_ENABLE_X64", "banana", "JAX can't start: invalid truth value 'banana'"),
        ("JAX_NUM_CPU_DEVICES", "many", "JAX can't start: Invalid value"),
        ("XLA_FLAGS", "--xla_bogus=1", "XLA refuses it: Unknown flag in XLA_FLAGS: --xla_bogus=1"),
        ("XLA_FLAGS", "--xla_cpu_enable_fast_math=x", "XLA refuses it: "),
        ("XLA_FLAGS", "nofile", "XLA refuses it: Could not open file"),
    ],
)
def test_a_variable_that_keeps_jax_from_starting_is_named(folder, name, value, words):
    environment = os.environ | {name: value}
    arguments = ("run", "tiny.toml", "--out", "a.zarr")
    ended = call(*arguments, code=2, folder=folder, environment=environment)
    assert re.match(rf"fic-sweep: (JAX_\S+ )*{name}={value}", ended.stderr)
    assert words in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert [p.name for p in folder.iterdir()] == ["tiny.toml"]


def test_xla_flags_may_stand_in_a_file(folder):
    """XLA reads them there; ours are added to them."""
    (folder / "flags").write_text("--xla_cpu_enable_fast_math=false\n")
    environment = os.environ | {"XLA_FLAGS": "flags"}
    call("run", "tiny.toml", code=0, folder=folder, environment=environment)


def test_a_deleted_folder_is_named(folder):
    ended = in_shell("mkdir a; cd a; rmdir ../a; fic-sweep status b.zarr", folder)
    assert ended.returncode == 2
    assert ended.stderr == b"fic-sweep: b.zarr: the folder that you are in was deleted\n"


def test_nohup_stays_after_the_terminal_has_gone(folder):
    line = "trap '' HUP; fic-sweep run tiny.toml --chunk 1 & kill -HUP $!; wait $!"
    ended = in_shell(line, folder)
    assert (ended.returncode, ended.stderr) == (0, b"")
