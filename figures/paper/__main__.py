"""Every figure of the paper into results/figures: `python -m figures.paper`."""

from fic_jax import tune_for_throughput
from figures.paper import (
    attractor,
    energy,
    environments,
    histories,
    profile,
    superposition,
    welded_contact,
)

SCRIPTS = (profile, attractor, energy, superposition, welded_contact, environments, histories)


def main() -> None:
    """Run all scripts."""
    tune_for_throughput()
    for script in SCRIPTS:
        script.main()


if __name__ == "__main__":
    main()
