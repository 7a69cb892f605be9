"""Strictness for every test: float64, no silent broadcasting or promotion, two CPU devices."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import jax
import pytest

import fic_jax
from sweeps.compile_cache import VARIABLE

# Before JAX starts: the engine's XLA flags, and two devices on any machine.
fic_jax.tune_for_throughput(2)
jax.config.update("jax_platforms", "cpu")  # XLA on a GPU divides and sums with other bits
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Programs are compiled once for all workers and for the commands that tests start, in a cache apart
# from the user's. The first process makes the folder, and removes it; the others inherit its name.
if VARIABLE not in os.environ:
    os.environ[VARIABLE] = tempfile.mkdtemp(prefix="fic-sweep-")
    atexit.register(shutil.rmtree, os.environ[VARIABLE], ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", os.environ[VARIABLE])


# What a run in this process sets, and the next test finds as it was.
BEFORE = {
    name: getattr(jax.config, name)
    for name in (
        "jax_compilation_cache_dir",
        "jax_enable_x64",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_platforms",
    )
}


@pytest.fixture(scope="session")
def shared_memory():
    """A folder in memory if possible: an fsync there takes no time."""
    place = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=place, prefix="fic-sweep-") as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def memory(shared_memory):
    """A folder of the module's own in memory."""
    return Path(tempfile.mkdtemp(dir=shared_memory))


@pytest.fixture(autouse=True)
def _configuration():
    yield
    for name, value in BEFORE.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)
