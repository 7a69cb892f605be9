"""What is measured, and the time that is left for it."""

import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Timer
from time import monotonic
from typing import Any, TypeVar

from benchmarks.child import BenchError, Child
from benchmarks.gpu.results import Results

PATIENCE = 120.0  # s; no compilation or call takes so long, unless it hangs
NO_TIME = "no time was left"
Item = TypeVar("Item")


class LeftOut(Exception):  # noqa: N818  not an error
    """No time is left."""


@dataclass(frozen=True)
class Plan:
    """Sizes and choices."""

    backends: tuple[str, ...]  # the first is the one that the others are compared with
    dtypes: tuple[str, ...]
    integrators: tuple[str, ...]
    readings: tuple[str, ...]  # of `correctness`; none: each option changed one at a time
    every: bool  # all combinations of options instead
    scenarios: int  # of each reading
    steps: int  # of each reading
    bits: int  # scenarios of the part `bits`
    sizes: tuple[int, ...]  # scenarios of the part `rates`
    run_steps: int  # of the other parts
    repeats: int
    jobs: int  # processes that compile side by side


@dataclass
class Session:
    """The command's run: its plan, its results, and when the present part has to end."""

    plan: Plan
    results: Results
    deadline: float = 0.0  # by `monotonic`
    _children: set[Child] = field(default_factory=set)

    def say(self, line: str) -> None:
        """A line about the progress."""
        sys.stderr.write(line + "\n")
        sys.stderr.flush()

    def ask(self, child: Child, function: str, **arguments: Any) -> Any:
        """The child's answer; it is killed at the deadline.

        Raises Missing with it, BenchError if the child ends, LeftOut if no time is left.
        """
        left = min(self.deadline - monotonic(), PATIENCE)
        if left <= 0:
            raise LeftOut(NO_TIME)
        stopped: list[bool] = []

        def stop() -> None:
            stopped.append(True)
            child.stop()

        timer = Timer(left, stop)
        timer.start()
        self._children.add(child)
        try:
            return child.call(function, **arguments)
        except BenchError as error:
            if monotonic() >= self.deadline:
                raise LeftOut(NO_TIME) from error
            raise BenchError(f"no answer in {left:.0f} s") if stopped else error from None
        finally:
            timer.cancel()
            self._children.discard(child)

    def failed(self, part: str, case: str, why: Exception) -> None:
        """Record why a case has no numbers."""
        line = (str(why).splitlines() or [type(why).__name__])[0][:300]
        if not isinstance(why, LeftOut):  # the table names those that time left out
            self.say(f"{part}: {case}: {line}")
        self.results.add(part, case, why=line)

    def side_by_side(self, work: Callable[[Item], None], items: Iterable[Item]) -> None:
        """Do the work for each item in threads, as many as the plan has jobs.

        An interruption, or an error of one, ends the children of all.
        """
        pool = ThreadPoolExecutor(self.plan.jobs)
        try:
            for _ in pool.map(work, items):
                pass
        except BaseException:
            self.deadline = 0.0
            for child in list(self._children):
                child.stop()
            raise
        finally:
            pool.shutdown(cancel_futures=True)
