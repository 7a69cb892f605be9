"""Independent reference simulators: plain Python and scipy, no JAX, no code of `fic_jax`."""
