"""Dask loads this in the workers of the tests: files in a folder say which blocks go wrong.

A file is named after its action; it contains the block, as text, or a number of seconds. A worker
that finds `deaf-N` hangs while it gets ready, until the end of the test; each takes one such file.
"""

import contextlib
import os
import signal
import time
from pathlib import Path

from sweeps import runner, worker

VARIABLE = "FIC_SWEEP_SABOTAGE"
COMPUTE, UNREADY = runner._compute, worker.unready


def dask_setup(_worker):
    runner._compute = compute
    worker.unready = unready


def unready(job):
    for file in Path(os.environ[VARIABLE]).glob("deaf-?"):
        mine = file.with_name(f"{file.name}-{os.getpid()}")
        with contextlib.suppress(FileNotFoundError):  # another worker has it
            file.rename(mine)
            while mine.exists():
                time.sleep(0.05)
    return UNREADY(job)


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
