"""Dask loads this in the workers of the tests: files in a folder say which blocks go wrong.

A file is named after its action; it contains the block, as text, or a number of seconds.
"""

import os
import signal
import time
from pathlib import Path

from sweeps import runner

VARIABLE = "FIC_SWEEP_SABOTAGE"
COMPUTE = runner._compute


def dask_setup(_worker):
    runner._compute = compute


def compute(grid, block, *rest):
    def wanted(action):
        file = Path(os.environ[VARIABLE], action)
        return file.exists() and file.read_text() in ("", str(block))

    if wanted("kill"):
        os.kill(os.getpid(), signal.SIGKILL)
    if wanted("fail"):
        raise MemoryError("no room")
    if wanted("hang"):
        Path(os.environ[VARIABLE], "hang").unlink()  # once
        time.sleep(1e6)
    slow = Path(os.environ[VARIABLE], "slow")
    if slow.exists():
        time.sleep(float(slow.read_text()))
    return COMPUTE(grid, block, *rest)
