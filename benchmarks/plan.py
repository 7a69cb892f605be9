"""How much a benchmark measures."""

from collections.abc import Callable
from dataclasses import dataclass

Say = Callable[[str], None]  # gets a line about the progress
DT = 0.01  # s, the paper's plant step
LONG = 200_000_000  # plant steps of a call; a longer one gets half the rounds


@dataclass(frozen=True)
class Plan:
    """Sizes and rounds."""

    scenarios: int | None = None  # of the largest calls; each table has its own default
    steps: int = 1_000
    repeats: int = 5
    full: bool = False  # larger runs
    peers: bool = False  # also measure the peers
    only: tuple[str, ...] = ()  # these tables, or all

    @property
    def few(self) -> int:
        """Rounds of a long measurement."""
        return max(self.repeats // 2, 1)

    def rounds(self, scenarios: int) -> int:
        """Rounds of a call with so many scenarios."""
        return self.repeats if scenarios * self.steps <= LONG else self.few
