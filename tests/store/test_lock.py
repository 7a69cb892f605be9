import errno
import fcntl
import os
from contextlib import suppress

import pytest

from sweeps.spec.mistakes import SweepError
from sweeps.store.lock import LOCK, locked, unchanged
from tests.store.faults import refusing


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


def test_readers_share_a_store_that_nobody_changes(tmp_path):
    with locked(tmp_path):
        pass
    with unchanged(tmp_path), unchanged(tmp_path):
        refusal = pytest.raises(SweepError, match="is being merged by another process; wait for it")
        with refusal, locked(tmp_path):
            pass
    refusal = pytest.raises(SweepError, match=f"is being changed by process {os.getpid()} on ")
    with locked(tmp_path), refusal, unchanged(tmp_path):
        pass


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL])
def test_a_file_system_without_locks_gets_a_warning(tmp_path, monkeypatch, number):
    """Lustre without its option `flock`, and NFS without a lock daemon, answer so."""
    monkeypatch.setattr(fcntl, "flock", refusing(number))
    warning = f"has no locks \\({os.strerror(number)}\\): nobody keeps a second process out"
    lock = locked(tmp_path)
    with pytest.warns(RuntimeWarning, match=warning):
        lock.__enter__().computing(7)
    assert b'"block": 7' in (tmp_path / LOCK).read_bytes()
    lock.__exit__(None, None, None)
    with pytest.warns(RuntimeWarning, match=warning), unchanged(tmp_path):
        pass


@pytest.mark.parametrize("lock", [locked, unchanged])
def test_another_error_is_an_error(tmp_path, monkeypatch, lock):
    (tmp_path / LOCK).touch()
    monkeypatch.setattr(fcntl, "flock", refusing(errno.EIO))
    with pytest.raises(OSError, match="Input/output error"), lock(tmp_path):
        pass
