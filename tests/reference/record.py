"""The record of an event-driven run: samples and event times."""

from collections.abc import Sequence

import numpy as np

from .cells import Cell, State

SAME_TIME = 1e-9
"""Requested times this close to a tick (s) are the tick: k dt and n period round differently."""


class Record:
    """Samples at the requested times, and the times of located events."""

    def __init__(self, times: Sequence[float] | np.ndarray) -> None:
        self.times = np.asarray(times, dtype=float)
        self.done = 0
        self.rows: list[tuple[float, ...]] = []
        self.made: list[float] = []
        self.lost: list[float] = []
        self.switches: list[float] = []
        self.latches: list[float] = []
        self.margins: list[float] = []
        self.last: Cell | None = None

    def due(self, t_stop: float) -> np.ndarray:
        """The requested times not yet sampled, up to t_stop."""
        upto = int(np.searchsorted(self.times, t_stop + SAME_TIME, side="right"))
        return np.minimum(self.times[self.done : upto], t_stop)

    def sample(self, x: float, v: float, s: State, cell: Cell) -> None:
        """Append one row; the next requested time becomes due."""
        row = (x, v, s.x_h, s.x_h - x, s.x_h - x if cell.diverging else s.e_M)
        self.rows.append((*row, cell.diverging, cell.torque(x), cell.reaction(x, v)))
        self.done += 1

    def enter(self, t: float, cell: Cell) -> None:
        """Record contact and mode changes from the last cell to this one, at time t."""
        if cell.contact and (self.last is None or not self.last.contact):
            self.made.append(t)
        if self.last is not None and self.last.contact and not cell.contact:
            self.lost.append(t)
        if self.last is not None and self.last.diverging != cell.diverging:
            self.switches.append(t)
        self.last = cell

    def jump(self, e_before: float, before: Cell, s: State) -> None:
        """Record by how much a jump of |e| at a tick outweighs the motion, as a time in s.

        `error_rate` sets a converging motion's e_M again if |e| grew since the last step, that is
        if the jump exceeds |v| dt. With dt above this margin the discretisation does not set it.
        """
        grown = abs(s.e) - abs(e_before)
        if not before.diverging and grown > 0.0:
            self.margins.append(grown / abs(s.v))

    def latch(self, t: float) -> None:
        """Record where a converging motion stopped."""
        self.latches.append(t)

    def pass_through(self, diverging: bool) -> None:
        """`switches` are the lasting changes of mode: a branch of one instant is none."""

    def rest(self, s: State, cell: Cell, t_stop: float) -> None:
        """Sample the constant state at the times due."""
        for _time in self.due(t_stop):
            self.sample(s.x, s.v, s, cell)

    def result(self) -> dict[str, np.ndarray]:
        """The arrays that `simulate` returns."""
        names = ("x", "v", "x_h", "e", "e_M", "diverging", "torque", "tau_env")
        columns = np.array(self.rows, dtype=float).reshape(-1, len(names)).T
        samples = dict(zip(names, columns, strict=True))
        samples["diverging"] = samples["diverging"].astype(bool)
        samples["t"] = self.times[: self.done]
        events = {"contact_made": self.made, "contact_lost": self.lost}
        events |= {"switches": self.switches, "latches": self.latches}
        events["margins"] = self.margins
        return samples | {name: np.array(values) for name, values in events.items()}
