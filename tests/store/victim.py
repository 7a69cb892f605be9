"""Processes that tests kill."""

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from sweeps import runner
from sweeps.merge import merge
from sweeps.store.ledger import _opened
from sweeps.store.lock import locked
from sweeps.store.opening import open_store
from tests.store.faults import Calls
from tests.store.stores import run, without_engine


def work(stores, path, number, seconds, pipe):
    """Make and run a store, or resume it; report the cells done.

    The system kills this process at its call `number`, or after `seconds`.
    """

    def fault(call):
        if call.number == number:
            os.kill(os.getpid(), signal.SIGKILL)

    with pytest.MonkeyPatch.context() as patch, Calls(path.parent, fault):
        without_engine(patch)
        if seconds:
            patch.setattr(runner, "ThreadPoolExecutor", ThreadPoolExecutor)  # as in a real run
            signal.setitimer(signal.ITIMER_REAL, seconds)  # SIGALRM kills like SIGKILL
        if not path.exists():
            stores.create(path)
        run(open_store(path), lambda progress: pipe.send(progress.done))
    pipe.send("ended")


def run_shard(path, plan, shard, number, pipe):
    """Run a shard, or what is left of it; the system kills this process at its call `number`."""

    def fault(call):
        if call.number == number:
            os.kill(os.getpid(), signal.SIGKILL)

    with pytest.MonkeyPatch.context() as patch, Calls(path.parent, fault):
        without_engine(patch)
        run(runner.start_or_reopen(path, plan, 2, 32, shard))
    pipe.send("ended")


def merge_parts(parts, path, number, pipe):
    """Merge; the system kills this process at its call `number`."""

    def fault(call):
        if call.number == number:
            os.kill(os.getpid(), signal.SIGKILL)

    with Calls(path.parent, fault):
        merge(parts, path)
    pipe.send("ended")


def hold(path, pipe):
    """Lock a folder until killed."""
    with locked(path):
        pipe.send("locked")
        time.sleep(1e6)


def half_a_commit(ledger):
    """Get killed when SQLite has written a part of a transaction into the ledger."""
    with _opened(ledger) as database:
        database.execute("PRAGMA cache_size = 2")  # pages: more go to the disk before the commit
        database.execute("BEGIN IMMEDIATE")
        database.execute("DELETE FROM blocks")
        rows = [(block, "x" * 4000, "") for block in range(50)]
        database.executemany("INSERT INTO blocks VALUES (?, ?, ?)", rows)
        os.kill(os.getpid(), signal.SIGKILL)
