"""`fic-sweep` as a user types it: in a process of its own, or in this one where it is quick."""

import io
import shutil
import subprocess
import sys
import sysconfig
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from unittest.mock import patch

from sweeps import cli, runner

FIC_SWEEP = shutil.which("fic-sweep", path=sysconfig.get_path("scripts"))


def call(*arguments, code, folder=None, environment=None):
    """What it printed, once it ended with `code` and without a traceback."""
    done = subprocess.run(
        [FIC_SWEEP, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == code, done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    return done


@dataclass(frozen=True)
class Told:
    """How a command ended."""

    code: int
    stdout: str
    stderr: str


def typed(*arguments):
    """The command in this process, JAX and the signals staying as the tests have them.

    What would be a traceback is raised.
    """
    out, err = io.StringIO(), io.StringIO()
    with (
        patch.object(sys, "argv", ["fic-sweep", *map(str, arguments)]),
        patch.object(cli, "_stop_between_blocks", list),
        patch.object(runner, "configure", lambda *_: None),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        code = cli._dispatch()
    return Told(code, out.getvalue(), err.getvalue())
