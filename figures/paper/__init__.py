"""The figures of the paper: `plot(data)` is pure, `figures()` simulates and plots.

Figures go by their labels in the paper's source, fig:0 to fig:9; LaTeX numbers them one or two
higher, for fig:00 comes first and fig:2 is missing.

| picture | label | printed | what it shows | file |
|---|---|---|---|---|
| profile | | | eq. 1, which no figure shows | profile.py |
| attractor | fig:0a | 2a | phase portrait | attractor.py |
| energy | fig:1a | 3a | released versus absorbed energy | energy.py |
| superposition | fig:1b | 3b | torque of both branches at the switch | superposition.py |
| mse_contact | fig:4 | 5 | nmse over K0 and Td | welded_contact.py |
| mse_impact | fig:5 | 6 | nmse over Kenv, over Denv | environments.py |
| history_welded | fig:6 | 7 | torque, torque error, position over time | histories.py |
| history_contact | fig:7 | 8 | the same | histories.py |
| history_stiffness | fig:8 | 9 | the same | histories.py |
| history_damping | fig:9 | 10 | the same | histories.py |

The last six, simulations of 10 s, are drawn at a step of 10 ms and, ending in _1ms, at 1 ms. What
is left, fig:00, 0b and 3, are drawings of a muscle, of a circuit and of the block diagram.
"""

from collections.abc import Iterator
from pathlib import Path

from figures import style
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


def write(folder: Path) -> Iterator[str]:
    """Write every figure as a PNG into a folder; yields each stem."""
    folder.mkdir(parents=True, exist_ok=True)
    for script in SCRIPTS:
        for name, figure in script.figures():
            style.save(figure, folder / f"{name}.png")
            yield name
