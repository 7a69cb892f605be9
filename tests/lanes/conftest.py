"""Kernels are compiled anew in each test: what a test changes is in no kernel's key."""

import jax
import pytest


@pytest.fixture(autouse=True)
def no_compile_cache():
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", folder)
