"""The signals of motions as columns of numbers: what the page draws of the cell and its pins."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sweeps.explore.motion import Motion

# Each has a contrast of 4.5 or more on white, and its own dashes: selected cell, then pins.
LOOKS = {
    "colour": ("#000000", "#b3460e", "#0066a6", "#8a1f7a"),
    "dash": ("solid", "dashed", "dotdash", "dotted"),
    "width": (1.6, 1.6, 1.6, 2.2),
}
COLUMNS = ("t", "T", "e", "x", "V", "v", "steps", "branch")
LEVELS = ("Td", "gap")  # constants that a plot has as a line
# A motion that has left this multiple of the largest torque is drawn no further.
DIVERGED = 1e3


def look(i: int) -> dict[str, Any]:
    """How the motion of the selected cell (0) or of a pin is drawn."""
    return {name: values[i] for name, values in LOOKS.items()}


def columns(motion: Motion) -> dict[str, Any]:
    """The signals of a motion as arrays, up to where it diverges."""
    s, p = motion.samples, motion.scenario.params
    T = np.asarray(s.tau_env)
    beyond = np.flatnonzero(~(np.abs(T) <= DIVERGED * max(abs(float(p.Td)), float(p.Fmax))))
    kept = int(beyond[0]) if beyond.size else T.size
    found = {"t": s.t, "T": T, "e": s.e, "x": s.x, "V": motion.V, "v": s.v}
    found = {name: np.asarray(values)[:kept] for name, values in found.items()}
    # a branch is that of the step that ends at t
    found["steps"] = np.repeat(np.append(0.0, found["t"]), 2)[1:-1]
    found["branch"] = np.repeat(np.asarray(s.diverging)[:kept], 2)
    return {name: np.ascontiguousarray(found[name], np.float32) for name in COLUMNS}


def drawn(motions: Sequence[Motion | None]) -> dict[str, list[Any]]:
    """Signals, looks and levels of the selected cell's motion and those of the pins, in columns."""
    there = [(i, motion, columns(motion)) for i, motion in enumerate(motions) if motion]
    data: dict[str, list[Any]] = {name: [one[name] for *_, one in there] for name in COLUMNS}
    data |= {name: [looks[i] for i, *_ in there] for name, looks in LOOKS.items()}
    params = [motion.scenario.params for _, motion, _ in there]
    return data | {name: [float(getattr(p, name)) for p in params] for name in LEVELS}
