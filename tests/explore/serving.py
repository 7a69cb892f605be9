"""The explorer's server as a process, which ends with the test."""

import os
import select
import signal
import subprocess
from contextlib import contextmanager

from tests.command import FIC_SWEEP

START = 60  # s until the server listens, on a busy machine


@contextmanager
def serving(*arguments, folder=None):
    """The link of a server."""
    command = [FIC_SWEEP, "explore", "--no-browser", "--port", "0", *map(str, arguments)]
    server = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        ready, _, _ = select.select([server.stdout], [], [], START)
        line = server.stdout.readline() if ready else ""
        assert line.startswith("http"), (line, server.poll(), os.linesep)
        yield line.split()[0]
    finally:
        server.send_signal(signal.SIGINT)
        try:
            _, errors = server.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            server.kill()
            raise
    assert server.returncode == 0, errors
    assert "Traceback" not in errors, errors
