"""Strictness for every test: float64, no silent broadcasting or promotion, two CPU devices."""

import atexit
import os
import shutil
import tempfile

import jax
import pytest

import fic_jax
from sweeps.compile_cache import VARIABLE

# Before JAX starts: the engine's XLA flags, and two devices on any machine.
fic_jax.tune_for_throughput(2)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Programs are compiled once for all workers and for the commands that tests start, in a cache apart
# from the user's. The first process makes the folder, and removes it; the others inherit its name.
if VARIABLE not in os.environ:
    os.environ[VARIABLE] = tempfile.mkdtemp(prefix="fic-sweep-")
    atexit.register(shutil.rmtree, os.environ[VARIABLE], ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", os.environ[VARIABLE])


@pytest.fixture(autouse=True)
def _precision():
    """A run in this process sets JAX's precision; the next test has float64 again."""
    yield
    jax.config.update("jax_enable_x64", True)
