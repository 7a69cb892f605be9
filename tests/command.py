"""Run `fic-sweep` as a user types it: in a process of its own, or, faster, in this one."""

import io
import os
import shutil
import subprocess
import sys
import sysconfig
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from unittest.mock import patch

from sweeps import cli, runner
from sweeps.cli import errors, interruption

FIC_SWEEP = shutil.which("fic-sweep", path=sysconfig.get_path("scripts"))


def call(*arguments, code, folder=None, environment=None):
    """Run the command in a process of its own; it must end with `code` and without a traceback."""
    done = subprocess.run(
        [FIC_SWEEP, *arguments],
        cwd=folder,
        env=(environment or os.environ) | {"PYTHONUTF8": "1"},  # whatever the locale
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == code, done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    return done


@dataclass(frozen=True)
class Ended:
    """What a command printed, and its exit code."""

    code: int
    stdout: str
    stderr: str


def typed(*arguments, configure=lambda *_: None):
    """Run the command in this process, without changing JAX or the signal handlers.

    `configure` sets JAX up, with the precision of a run. Raises what would be a traceback.
    """
    out, err = io.StringIO(), io.StringIO()
    with (
        patch.object(sys, "argv", ["fic-sweep", *map(str, arguments)]),
        patch.object(interruption, "stop_on_signals", interruption.Stop),
        patch.object(runner, "configure", configure),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        code = errors.dispatch(cli.app)
    return Ended(code, out.getvalue(), err.getvalue())
