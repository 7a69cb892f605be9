"""The process starts without large packages and ends with its exit code, all output written."""

import os
import re
import subprocess
import sys

import pytest

from tests.command import FIC_SWEEP

HELP = """
import sys
from sweeps import cli
from sweeps.cli import errors
sys.argv[1:] = ["--help"]
assert errors.dispatch(cli.app) == 0
print(*sys.modules)
"""
COMMANDS = [
    "list",
    "show",
    "run",
    "resume",
    "merge",
    "reduce",
    "verify",
    "status",
    "plot",
    "history",
    "export",
    "share",
    "explore",
    "bench",
    "report",
]
LARGE = {
    "jax", "numpy", "scipy", "xarray", "zarr", "pandas", "pydantic", "matplotlib", "fic_jax",
    "figures", "benchmarks",
}  # fmt: skip


def test_help_names_every_command_and_imports_no_large_package():
    """`fic-sweep --help` takes 0.1 s; importing jax alone takes half a second."""
    *lines, modules = subprocess.run(
        [sys.executable, "-c", HELP], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert [m[1] for line in lines if (m := re.match(r"  (\w+)  ", line))] == COMMANDS
    assert not LARGE & set(modules.split())


END = """
import atexit, sys
from sweeps.cli import process

def command():
    atexit.register(print, "cleaned up")
    print("done")
    if sys.argv[1:]:
        raise RuntimeError("a mistake of ours")
    return 2

process.exit_with(command)
"""


@pytest.mark.parametrize(
    ("arguments", "code", "error"), [([], 2, ""), (["wrong"], 1, "a mistake of ours")]
)
def test_the_process_prints_cleans_up_and_ends_with_the_exit_code(arguments, code, error):
    ended = subprocess.run(
        [sys.executable, "-c", END, *arguments], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stdout) == (code, "done\ncleaned up\n")
    assert error in ended.stderr
    assert bool(ended.stderr) == bool(error)


def test_a_closed_output_gives_no_traceback():
    """As in `fic-sweep list | true`; nobody can read from the pipe before the command starts."""
    reader, writer = os.pipe()
    os.close(reader)
    buffered = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    try:
        ended = subprocess.run(
            [FIC_SWEEP, "--version"],
            env=buffered,
            stdout=writer,
            stderr=subprocess.PIPE,
            check=False,
        )
    finally:
        os.close(writer)
    assert (ended.returncode, ended.stderr) == (1, b"")
