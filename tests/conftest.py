"""Strictness for every test: float64, no silent broadcasting or promotion, two CPU devices."""

import jax

import fic_jax

# Before the backend starts: what the engine wants, and two devices wherever the tests run.
fic_jax.tune_for_throughput(2)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
