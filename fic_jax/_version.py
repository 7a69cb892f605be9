"""Which fic_jax this is."""

__version__ = "0.1.0"
# Raise it with every change that changes a number of a sweep; tests/engine/test_bits.py guards
# it. A store records it, and `fic-sweep resume` continues no store with other numerics.
NUMERICS = 2
