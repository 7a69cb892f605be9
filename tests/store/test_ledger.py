import errno
import fcntl
import hashlib
import sqlite3
from contextlib import closing

import pytest

from sweeps.store import ledger as ledger_module
from sweeps.store.ledger import CHECKSUM, Ledger, LedgerError, _opened
from sweeps.store.opening import open_store
from sweeps.store.verify import verify
from tests.store.faults import refusing
from tests.store.stores import contents, run


def test_a_commit_survives_a_power_cut(golden):
    """With synchronous = EXTRA (3), SQLite fsyncs the deletion of the journal, its commit."""
    with _opened(golden / "ledger.sqlite") as database:
        assert database.execute("PRAGMA synchronous").fetchone() == (3,)
        assert database.execute("PRAGMA journal_mode").fetchone() == ("delete",)


@pytest.mark.parametrize("column", ["path", "body", "content", "sha256"])
def test_a_changed_metadata_row_is_detected(golden, column):
    ledger = Ledger(golden / "ledger.sqlite")
    rows, files = ledger.undamaged()
    with closing(sqlite3.connect(ledger.path)) as database, database:
        database.execute(f"UPDATE fixed SET {column} = 'x' WHERE path = 'Td/c.0'")
    with pytest.raises(LedgerError, match="is not as it was written"):
        list(ledger.metadata())
    assert ledger.undamaged() == (rows, [file for file in files if file.path != "Td/c.0"])


@pytest.mark.parametrize("column", ["block", "body", "sha256"])
def test_a_changed_row_of_a_block_is_detected(golden, column):
    ledger = Ledger(golden / "ledger.sqlite")
    rows, files = ledger.undamaged()
    with closing(sqlite3.connect(ledger.path)) as database, database:
        database.execute(f"UPDATE blocks SET {column} = 9 WHERE block = 1")
    with pytest.raises(LedgerError, match=r"the row of block \d is not as it was written"):
        list(ledger.rows())
    assert ledger.undamaged() == ([row for row in rows if row.block != 1], files)


def test_a_row_with_a_right_checksum_and_a_wrong_content_is_damage(golden):
    ledger = Ledger(golden / "ledger.sqlite")
    for table, key in (("blocks", 7), ("fixed", "Td/c.5")):
        digest = hashlib.sha256(f"{key}\n{{".encode()).hexdigest()
        values = (key, "{", None, digest) if table == "fixed" else (key, "{", digest)
        with closing(sqlite3.connect(ledger.path)) as database, database:
            database.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(values))})", values)
    for read, row in ((ledger.rows, "block 7"), (ledger.metadata, r"Td/c\.5")):
        with pytest.raises(LedgerError, match=f"the row of {row} is not as it was written"):
            list(read())


def test_an_index_that_lost_its_rows_is_damage(golden):
    """Every row still has its checksum."""
    ledger = Ledger(golden / "ledger.sqlite")
    (golden / CHECKSUM).unlink()
    with closing(sqlite3.connect(ledger.path)) as database:
        query = "SELECT rootpage FROM sqlite_schema WHERE type = 'index'"
        ((page,),) = database.execute(query).fetchall()
    content = bytearray(ledger.path.read_bytes())
    content[(page - 1) * 4096 : page * 4096] = b"\x0a\0\0\0\0\x10\0\0".ljust(4096, b"\0")
    ledger.path.write_bytes(content)
    with pytest.raises(LedgerError, match="index"):
        ledger.check()


@pytest.fixture
def without_locks(monkeypatch):
    """As on a file system without locks. SQLite calls them itself, and would fail or wait."""
    monkeypatch.setattr(fcntl, "lockf", refusing(errno.ENOLCK))
    monkeypatch.setattr(fcntl, "flock", refusing(errno.ENOSYS))


@pytest.mark.filterwarnings("ignore:the file system has no locks")
def test_a_ledger_works_without_locks(golden, without_locks):
    """Another connection holds the lock that SQLite would wait for."""
    ledger = Ledger(golden / "ledger.sqlite")
    with closing(sqlite3.connect(ledger.path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        rows = list(ledger.rows())
        ledger.insert(rows)
        assert list(ledger.rows()) == rows


def test_a_reader_without_locks_waits_for_a_commit(golden, without_locks, monkeypatch):
    """It would take the journal of a live process for one that a kill left, and roll it back."""
    journal = golden / "ledger.sqlite-journal"
    journal.write_bytes(b"of a live process")
    monkeypatch.setattr(ledger_module.time, "sleep", lambda _: journal.unlink())
    with pytest.warns(RuntimeWarning, match="nobody keeps a second process out"):
        assert list(Ledger(golden / "ledger.sqlite").rows())
    assert not journal.exists()


@pytest.mark.filterwarnings("ignore:the file system has no locks")
def test_a_run_without_locks_gives_the_same_store(stores, quick, without_locks):
    with stores.case() as path:
        stores.create(path)
        run(open_store(path))
        assert contents(path) == stores.expected[5]
        assert not verify(path).problems
