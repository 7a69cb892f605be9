import os
from contextlib import suppress

import pytest

from sweeps.spec.mistakes import SweepError
from sweeps.store.lock import LOCK, locked


def test_a_second_lock_is_refused_with_the_process_that_holds_the_first(tmp_path):
    with (
        locked(tmp_path),
        pytest.raises(SweepError, match=f"is being changed by process {os.getpid()} on "),
        locked(tmp_path),
    ):
        pass


def test_the_next_process_learns_the_block_of_a_kill(tmp_path):
    """A kill leaves the note. An error ends the process in order, and deletes it."""
    with locked(tmp_path) as lock:
        lock.computing(7)
        killed = (tmp_path / LOCK).read_bytes()
    (tmp_path / LOCK).write_bytes(killed)
    with suppress(ZeroDivisionError), locked(tmp_path) as lock:
        assert lock.killed_in == 7
        lock.computing(8)
        raise ZeroDivisionError
    with locked(tmp_path) as lock:
        assert lock.killed_in is None
