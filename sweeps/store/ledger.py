"""The ledger: which blocks of a store are done, and what every file must contain.

A small SQLite database beside the arrays. Each row carries a checksum of itself, so that a flipped
bit is detected.
"""

import fcntl
import hashlib
import json
import os
import re
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from sweeps.store.fsync import UNSUPPORTED
from sweeps.store.lock import warn_without_locks

LEDGER = "ledger.sqlite"
CHECKSUM = "ledger.sha256"  # of the whole ledger while no process writes; `sha256sum -c` reads it
LARGEST_COPY = 1_000_000  # bytes: the ledger holds a copy of each metadata file up to this size

DONE, PARTLY, SET_ASIDE = "done", "partly", "set aside"

JOURNAL_CHECKS, JOURNAL_PAUSE = 50, 0.1  # s; a commit takes milliseconds

SCHEMA = (
    "CREATE TABLE fixed (path TEXT PRIMARY KEY, body TEXT, content BLOB, sha256 TEXT)",
    "CREATE TABLE blocks (block INTEGER PRIMARY KEY, body TEXT, sha256 TEXT)",
)
# The metadata files of a store. A ledger from somebody else could name a file outside the store.
METADATA = re.compile(r"zarr\.json|[A-Za-z0-9_]+/(zarr\.json|c\.\d+)")
BLOCKS = "SELECT * FROM blocks ORDER BY block"
FIXED = "SELECT * FROM fixed ORDER BY path"


class LedgerError(Exception):
    """The ledger is damaged."""


@dataclass(frozen=True)
class Checksum:
    """Length and SHA-256 of a file."""

    size: int  # bytes
    sha256: str

    @classmethod
    def of(cls, content: bytes) -> "Checksum":
        return cls(len(content), hashlib.sha256(content).hexdigest())


def intact(path: Path, checksum: Checksum) -> bool:
    """Whether a file has the content of its checksum. A link never has."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size != checksum.size:
        return False
    return Checksum.of(path.read_bytes()) == checksum


@dataclass(frozen=True)
class Row:
    """What the ledger knows of a block."""

    block: int
    # DONE; PARTLY: a smaller store had some of its cells; SET_ASIDE: every attempt failed
    outcome: str
    ok: int = 0  # cells
    diverged: int = 0
    failed: int = 0
    trusted: int | dict[str, int] = 0  # by metric; in formats 1 and 2 a number, of nmse
    seconds: float = 0.0  # of computing
    attempt: int = 1  # the one that succeeded, or the last
    at: str = ""  # UTC
    error: str = ""  # of the last attempt, if SET_ASIDE
    files: dict[str, Checksum] = field(default_factory=dict)  # by variable


@dataclass(frozen=True)
class MetadataFile:
    """What the ledger knows of a file outside the blocks: a zarr.json or a coordinate's chunk."""

    path: str  # in the store
    checksum: Checksum
    content: bytes | None  # up to LARGEST_COPY


@dataclass(frozen=True)
class Ledger:
    """The ledger at `path`. Each method opens and closes it, so threads may share the object."""

    path: Path

    @classmethod
    def create(cls, path: Path) -> "Ledger":
        """Make an empty ledger. Raises OSError."""
        with _opened(path, "rwc") as database:
            for table in SCHEMA:
                database.execute(table)
        return cls(path)

    def insert(self, rows: Iterable[Row]) -> None:
        """Write rows, all or none. After the return a power cut loses none. Raises OSError."""
        bodies = [(row.block, _body(row)) for row in rows]
        with _opened(self.path) as database, database:
            database.executemany(
                "INSERT OR REPLACE INTO blocks VALUES (?, ?, ?)",
                [(block, body, _digest(block, body)) for block, body in bodies],
            )

    def delete(self, blocks: Iterable[int]) -> None:
        """Delete the rows of blocks, which must then run again."""
        with _opened(self.path) as database, database:
            database.executemany("DELETE FROM blocks WHERE block = ?", [(b,) for b in blocks])

    def insert_metadata(self, files: Iterable[tuple[str, bytes]]) -> None:
        """Write what metadata files contain."""
        with _opened(self.path) as database, database:
            for path, content in files:
                body = json.dumps(asdict(Checksum.of(content)))
                copy = content if len(content) <= LARGEST_COPY else None
                database.execute(
                    "INSERT OR REPLACE INTO fixed VALUES (?, ?, ?, ?)",
                    (path, body, copy, _digest(path, body)),
                )

    def files(self) -> int:
        """The number of files in the store's journal."""
        return sum(number for (number,) in self._select("PRAGMA user_version"))

    def count_files(self, number: int) -> None:
        """Write the number of files in the journal: SQLite's header has a number for its user."""
        with _opened(self.path) as database:
            database.execute(f"PRAGMA user_version = {number:d}")

    def rows(self) -> Iterator[Row]:
        """The row of each block, in order. Raises LedgerError at the first damaged one."""
        return (_row(*record) for record in self._select(BLOCKS))

    def metadata(self) -> Iterator[MetadataFile]:
        """The metadata files. Raises LedgerError at the first damaged row."""
        return (_metadata(*record) for record in self._select(FIXED))

    def undamaged(self) -> tuple[list[Row], list[MetadataFile]]:
        """The good rows of a ledger that may be damaged."""

        def good(query: str, parse: Callable[..., Any]) -> Iterator[Any]:
            with suppress(LedgerError, OSError):
                for record in self._select(query):
                    with suppress(LedgerError):
                        yield parse(*record)

        return list(good(BLOCKS, _row)), list(good(FIXED, _metadata))

    def check(self) -> None:
        """Read the whole ledger. Raises LedgerError if any of it is damaged."""
        for (message,) in self._select("PRAGMA integrity_check"):
            if message != "ok":
                raise LedgerError(str(message).splitlines()[-1])
        checksum = self.path.with_name(CHECKSUM)
        if os.path.lexists(checksum) and not intact(checksum, Checksum.of(self.checksum())):
            raise LedgerError(f"it differs from {CHECKSUM}, its checksum")
        list(self.rows())
        list(self.metadata())

    def checksum(self) -> bytes:
        """The content of the file CHECKSUM for the ledger as it is."""
        return f"{hashlib.sha256(self.path.read_bytes()).hexdigest()}  {LEDGER}\n".encode()

    def _select(self, query: str) -> Iterator[Any]:
        # Opened for writing too: the next reader rolls back a commit that a kill cut short.
        with _opened(self.path) as database:
            yield from database.execute(query)


def _body(row: Row) -> str:
    values = asdict(row)
    del values["block"]
    return json.dumps(values)


def _row(block: Any, body: Any, digest: Any) -> Row:
    with suppress(TypeError, ValueError):
        if _digest(block, body) == digest:
            return _ROW.validate_python({"block": block} | json.loads(body))
    raise LedgerError(f"the row of block {block} is not as it was written")


def _metadata(path: Any, body: Any, content: Any, digest: Any) -> MetadataFile:
    with suppress(TypeError, ValueError):
        checksum = _CHECKSUM.validate_json(body)
        copied = content is None or Checksum.of(content) == checksum
        if copied and _digest(path, body) == digest and METADATA.fullmatch(str(path)):
            return MetadataFile(path, checksum, content)
    raise LedgerError(f"the row of {path} is not as it was written")


_ROW, _CHECKSUM = TypeAdapter(Row), TypeAdapter(Checksum)


def _digest(key: object, body: str) -> str:
    return hashlib.sha256(f"{key}\n{body}".encode()).hexdigest()


@contextmanager
def _opened(path: Path, mode: str = "rw") -> Iterator[sqlite3.Connection]:
    """A connection whose commits are on the disk when they return.

    Raises OSError for what the system refuses, LedgerError for a damaged or foreign file.
    """
    for file in (path, path.with_name(f"{path.name}-journal")):
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise LedgerError(f"{file.name} is no file")
    try:
        address = f"{path.absolute().as_uri()}?mode={mode}"
        if not _has_locks(path.parent / "zarr.json"):
            _wait_for_commit(path)
            address += "&nolock=1"
        # timeout: a reader in another process holds the ledger for milliseconds
        with closing(sqlite3.connect(address, uri=True, timeout=60)) as database:
            # The commit is the deletion of the journal, which FULL does not fsync.
            database.execute("PRAGMA synchronous = EXTRA")
            yield database
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "")  # none if Python can't decode a text
        if name.startswith(_REFUSED):
            raise OSError(None, f"{error}", str(path)) from None
        raise LedgerError(str(error)) from None


def _has_locks(neighbour: Path) -> bool:
    """Whether the file system of a file has the locks that SQLite wants.

    Without them SQLite fails, or waits a minute for a lock that nobody holds. A neighbour of the
    ledger is tried: a process that closes the ledger itself would lose SQLite's locks on it.
    """
    try:
        descriptor = os.open(neighbour, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:  # damaged, or no store: SQLite answers
        return True
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in UNSUPPORTED:
            warn_without_locks(error)
            return False
    finally:
        os.close(descriptor)
    return True


def _wait_for_commit(path: Path) -> None:
    """Wait for the end of another process's commit, which no lock shows.

    A journal that stays is from a killed process: SQLite rolls it back.
    """
    journal = path.with_name(f"{path.name}-journal")
    for _ in range(JOURNAL_CHECKS):
        if not journal.exists():
            return
        time.sleep(JOURNAL_PAUSE)


_REFUSED = tuple(f"SQLITE_{n}" for n in ("BUSY", "CANTOPEN", "FULL", "IOERR", "READONLY"))
