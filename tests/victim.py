"""A process that runs or resumes a sweep, and tells how far it is; to be killed."""

import os
import time
from multiprocessing.connection import Connection
from pathlib import Path

import jax
import numpy as np
from numcodecs.blosc import get_mutex

from fic_jax import engine
from sweeps import runner
from sweeps.compile_cache import VARIABLE
from sweeps.spec.reading import parse
from sweeps.store.lock import owning

get_mutex()  # once for all processes forked from one that has imported this
BLOCKS = 8
CELLS = 1024
TEXT = """
name = "victim"
[time]
t_end = 5.0
[axes]
K0 = { log = [1.0, 300.0], n = 64 }
Td = { lin = [1.0, 9.0], n = 16 }
"""


def work(path: Path, programs: Path, told: Connection) -> None:
    """What `fic-sweep run` or `resume` does, whichever it takes."""
    os.environ[VARIABLE] = str(programs)
    runner.configure(32)
    plan = parse(TEXT, "victim.toml")
    if path.exists():
        store = runner.reopen(path, 32)
    else:
        store = runner.start(path, plan, CELLS // BLOCKS, 32)
    runner.run(store, lambda progress: told.send(progress.done))
    told.send("ended")


def keep(programs: Path) -> None:
    """The engine's program, compiled: tracing it takes longer than all the rest of a run."""
    os.environ[VARIABLE] = str(programs)
    runner.configure(32)
    engine._compiled(engine.Model(), 500, False, np.dtype("float32"), tuple(jax.local_devices()))


def own(path: Path, told: Connection) -> None:
    """Hold a store, or a folder in which one is made, until killed."""
    with owning(path):
        told.send("owned")
        time.sleep(600)
