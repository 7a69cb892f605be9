"""What is asked of a bench, and the words all its tables share."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Tell = Callable[[str], None]  # told what is being done
Table = dict[str, Any]
DT = 0.01  # s, the paper's plant step
LONG = 200_000_000  # plant steps of a call, above which fewer repeats have to do


@dataclass(frozen=True)
class Plan:
    """Sizes of a bench; `scenarios` instead of each table's own if given."""

    scenarios: int | None = None
    steps: int = 1_000
    repeats: int = 5
    full: bool = False
    only: tuple[str, ...] = ()  # tables; all if empty

    def rounds(self, scenarios: int) -> int:
        """How often a call of that many scenarios is timed."""
        return self.repeats if scenarios * self.steps <= LONG else self.few

    @property
    def few(self) -> int:
        """How often something long is timed."""
        return max(self.repeats // 2, 1)


def summary(values: list[float], best: Callable[[list[float]], float] = min) -> Table:
    """Median and best of what was measured, and all of it in the order of the rounds."""
    return {"median": statistics.median(values), "best": best(values), "all": values}


def within(value: float, at_least: float | None = None, at_most: float | None = None) -> Table:
    """A target beside what was reached; empty without one."""
    if at_least is not None:
        return {"target": {"at_least": at_least}, "met": value >= at_least}
    if at_most is not None:
        return {"target": {"at_most": at_most}, "met": value <= at_most}
    return {}
