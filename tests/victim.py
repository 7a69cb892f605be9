"""A process that runs or resumes a sweep, and tells how far it is; to be killed."""

import os
import pickle
import time
from dataclasses import replace
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path

import jax
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize
from numcodecs.blosc import get_mutex

from fic_jax import engine
from fic_jax.blocks import LANES
from sweeps import runner
from sweeps.cache import VARIABLE
from sweeps.owner import owning
from sweeps.validation import parse

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


def work(path: Path, program: Path, told: Connection) -> None:
    """What `fic-sweep run` or `resume` does, whichever it takes."""
    runner.configure(32)
    load(program)
    plan = parse(TEXT, "victim.toml")
    if path.exists():
        store = runner.reopen(path, 32)
    else:
        store = runner.start(path, plan, CELLS // BLOCKS, 32)
    runner.run(store, lambda progress: told.send(progress.done))
    told.send("ended")


def keep(program: Path) -> None:
    """The engine's program, compiled: tracing it takes longer than all the rest of a run."""
    os.environ[VARIABLE] = ""  # what comes out of the cache of programs can't be written again
    runner.configure(32)
    engine.ARRANGEMENT["cpu"] = "scan"  # a program that can be written
    arguments = engine.Model(), 500, False, np.dtype("float32"), tuple(jax.local_devices())
    made = engine._compiled(*arguments).fill
    shape = (len(engine.QUANTITIES), made.n_devices, made.blocks, LANES)
    columns = jax.ShapeDtypeStruct(shape, np.float32, sharding=made.sharding)
    whole = made.run.lower(columns, np.float32(0.01), np.int32(1)).compile()
    program.write_bytes(pickle.dumps(serialize(whole)))


def load(program: Path) -> None:
    """Give the engine its program, instead of having it traced again."""
    engine.ARRANGEMENT["cpu"] = "scan"
    make = engine._compiled

    @cache
    def compiled(*arguments):
        run = deserialize_and_load(*pickle.loads(program.read_bytes()))
        made = make(*arguments)
        return replace(made, fill=replace(made.fill, run=run))

    engine._compiled = compiled


def own(path: Path, told: Connection) -> None:
    """Hold a store, or a folder in which one is made, until killed."""
    with owning(path):
        told.send("owned")
        time.sleep(600)
