"""Without the compile cache: a test patches the compiler, and no cache key would show it."""

import jax
import pytest


@pytest.fixture(autouse=True)
def no_compile_cache():
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", folder)
