"""A thread that computes for the open pages; of each page's requests the newest wins."""

import threading
import time
import traceback
from collections.abc import Callable, Hashable

Stale = Callable[[], bool]  # whether a job's result is no longer wanted
Job = Callable[[Stale], None]


class Worker:
    """Runs one job at a time. A new job replaces the one of the same key that has not begun.

    A job that has begun asks `stale()` now and then, and returns if it is.
    """

    def __init__(self, name: str) -> None:
        self._changed = threading.Condition()  # its lock is reentrant
        self._jobs: dict[Hashable, tuple[float, int, Job]] = {}
        self._newest: dict[Hashable, int] = {}
        self._count = 0
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def submit(self, key: Hashable, job: Job, delay: float = 0.0) -> None:
        """Run a job after `delay` seconds, unless another one of this key comes before."""
        with self._changed:
            self._count += 1
            self._newest[key] = self._count
            self._jobs[key] = time.monotonic() + delay, self._count, job
            self._changed.notify()

    def then(self, key: Hashable, stale: Stale, job: Job, delay: float = 0.0) -> None:
        """`submit` from a job of this key, unless a newer one waits."""
        with self._changed:
            if not stale():
                self.submit(key, job, delay)

    def drop(self, key: Hashable) -> None:
        """Forget a key: its job does not run, and if it has begun its result is stale."""
        with self._changed:
            self._jobs.pop(key, None)
            self._newest.pop(key, None)

    def _next(self) -> tuple[Hashable, int, Job]:
        with self._changed:
            while True:
                due = min(
                    ((when, n, key) for key, (when, n, _) in self._jobs.items()),
                    default=None,
                    key=lambda d: d[:2],
                )
                wait = None if due is None else due[0] - time.monotonic()
                if due is not None and wait is not None and wait <= 0:
                    key = due[2]
                    _, n, job = self._jobs.pop(key)
                    return key, n, job
                self._changed.wait(wait)

    def _work(self) -> None:
        while True:
            key, n, job = self._next()
            try:
                job(lambda key=key, n=n: self._newest.get(key) != n)  # type: ignore[misc]
            except Exception:  # a fault of ours must not end the thread: the next job may work
                traceback.print_exc()
