"""Every figure of the paper into results/figures: `python -m figures.paper`."""

from pathlib import Path

from fic_jax import tune_for_throughput
from figures.paper import write

tune_for_throughput()
for _ in write(Path("results/figures")):
    pass
