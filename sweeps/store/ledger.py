"""The ledger: which blocks of a store are done, and what every file of it must contain.

A small SQLite database beside the arrays. A block is done when, and only when, it has a row here,
and a row is written only after the block's files are on the disk. Each row carries a checksum of
itself, so that a damaged ledger is told from a true one.
"""

import hashlib
import json
import os
import re
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

NAME = "ledger.sqlite"
SEAL = "ledger.sha256"  # of the whole ledger while no process writes it; `sha256sum -c` reads it
KEPT = 1_000_000  # bytes: smaller files outside the blocks are kept in the ledger as a copy

DONE, PARTLY, SET_ASIDE = "done", "partly", "set aside"

SCHEMA = (
    "CREATE TABLE fixed (path TEXT PRIMARY KEY, body TEXT, content BLOB, sha256 TEXT)",
    "CREATE TABLE blocks (block INTEGER PRIMARY KEY, body TEXT, sha256 TEXT)",
)
# A store can come from somebody else. What a ledger may name outside the blocks:
FIXED = re.compile(r"zarr\.json|[A-Za-z0-9_]+/(zarr\.json|c\.\d+)")
LONGEST = 4 * KEPT  # bytes of a value
ROLLBACK = b"\1\1"  # at byte 18 of a database whose journal is one file beside it
SUPER = bytes.fromhex("d9d505f920a163d7")  # the end of a journal that names a file to be removed


class LedgerError(Exception):
    """The ledger can't be read, or not all of it can be right."""


@dataclass(frozen=True)
class Stamp:
    """What a file contains: its length and its checksum."""

    size: int  # bytes
    sha256: str

    @classmethod
    def of(cls, content: bytes) -> "Stamp":
        return cls(len(content), hashlib.sha256(content).hexdigest())


def intact(path: Path, stamp: Stamp) -> bool:
    """Whether a file contains what the ledger says."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size != stamp.size:
        return False
    return Stamp.of(path.read_bytes()) == stamp


@dataclass(frozen=True)
class Row:
    """A block in the ledger."""

    block: int
    outcome: str  # DONE; PARTLY: some cells came from a smaller store; SET_ASIDE: it kept failing
    ok: int = 0  # cells
    diverged: int = 0
    failed: int = 0
    trusted: int = 0
    seconds: float = 0.0  # of computing
    attempt: int = 1  # that succeeded, or the last one
    at: str = ""  # UTC
    error: str = ""  # of the last attempt of a block set aside
    files: dict[str, Stamp] = field(default_factory=dict)  # by variable


@dataclass(frozen=True)
class Fixed:
    """A file outside the blocks: metadata, coordinates."""

    path: str  # in the store
    stamp: Stamp
    content: bytes | None  # a copy of a small one


@dataclass(frozen=True)
class Ledger:
    """The ledger at `path`; every call opens and closes it, so threads may share it."""

    path: Path

    @classmethod
    def create(cls, path: Path) -> "Ledger":
        """An empty ledger. Raises OSError."""
        with _opened(path, "rwc") as database:
            for table in SCHEMA:
                database.execute(table)
        return cls(path)

    def add(self, rows: Iterable[Row]) -> None:
        """Write rows, all or none; once this returns, a power cut loses none. Raises OSError."""
        bodies = [(row.block, _body(row)) for row in rows]
        with _opened(self.path, "rw") as database, database:
            database.executemany(
                "INSERT OR REPLACE INTO blocks VALUES (?, ?, ?)",
                [(block, body, _digest(block, body)) for block, body in bodies],
            )

    def forget(self, blocks: Iterable[int]) -> None:
        """Take blocks out of the ledger: they are to be run again."""
        with _opened(self.path, "rw") as database, database:
            database.executemany("DELETE FROM blocks WHERE block = ?", [(b,) for b in blocks])

    def fix(self, files: Iterable[tuple[str, bytes]]) -> None:
        """Note what files outside the blocks contain, with a copy of the small ones."""
        with _opened(self.path, "rw") as database, database:
            for path, content in files:
                body = json.dumps(asdict(Stamp.of(content)))
                kept = content if len(content) <= KEPT else None
                database.execute(
                    "INSERT OR REPLACE INTO fixed VALUES (?, ?, ?, ?)",
                    (path, body, kept, _digest(path, body)),
                )

    def rows(self) -> Iterator[Row]:
        """Every block of the ledger in order. Raises LedgerError at the first bad row."""
        for block, row in self._rows():
            if row is None:
                raise LedgerError(f"the row of block {block} is not as it was written")
            yield row

    def fixed(self) -> Iterator[Fixed]:
        """Files outside the blocks. Raises LedgerError at the first bad row."""
        for path, fixed in self._fixed():
            if fixed is None:
                raise LedgerError(f"the row of {path} is not as it was written")
            yield fixed

    def good(self) -> tuple[list[Row], list[Fixed]]:
        """What is as it was written, of a ledger that may be damaged."""
        rows: list[Row] = []
        fixed: list[Fixed] = []
        with suppress(LedgerError, OSError):
            rows.extend(row for _, row in self._rows() if row)
        with suppress(LedgerError, OSError):
            fixed.extend(one for _, one in self._fixed() if one)
        return rows, fixed

    def check(self) -> None:
        """Read all of it. Raises LedgerError where not everything is as it was written."""
        if self.path.is_symlink():
            raise LedgerError("it is a link")
        for (told,) in self._select("PRAGMA integrity_check"):
            if told != "ok":
                raise LedgerError(str(told).splitlines()[-1])
        seal = self.path.with_name(SEAL)
        if os.path.lexists(seal) and not intact(seal, Stamp.of(self.sealed())):
            raise LedgerError(f"it differs from {SEAL}, its checksum")
        list(self.rows())
        list(self.fixed())

    def sealed(self) -> bytes:
        """What the seal of the ledger as it is must contain."""
        return f"{hashlib.sha256(self.path.read_bytes()).hexdigest()}  {NAME}\n".encode()

    def _rows(self) -> Iterator[tuple[int, Row | None]]:
        for block, body, told in self._select("SELECT * FROM blocks ORDER BY block"):
            yield block, _row(block, body, told)

    def _fixed(self) -> Iterator[tuple[str, Fixed | None]]:
        for path, *rest in self._select("SELECT * FROM fixed ORDER BY path"):
            yield str(path), _fixed(path, *rest)

    def _select(self, query: str) -> Iterator[Any]:
        # for writing too: a commit that a kill cut short is undone by whoever reads next
        with _opened(self.path, "rw") as database:
            yield from database.execute(query)


def _body(row: Row) -> str:
    values = asdict(row)
    del values["block"]
    return json.dumps(values)


def _row(block: object, body: Any, told: object) -> Row | None:
    """A row as it was written, or None."""
    if _digest(block, body) != told:
        return None
    try:
        return _ROW.validate_python({"block": block} | json.loads(body))
    except (TypeError, ValueError, RecursionError):
        return None


def _fixed(path: Any, body: Any, content: Any, told: object) -> Fixed | None:
    """A file outside the blocks as it was noted, or None."""
    if _digest(path, body) != told or not FIXED.fullmatch(str(path)):
        return None
    try:
        stamp = _STAMP.validate_python(json.loads(body))
        good = content is None or Stamp.of(content) == stamp
    except (TypeError, ValueError, RecursionError):
        return None
    return Fixed(path, stamp, content) if good else None


_ROW, _STAMP = TypeAdapter(Row), TypeAdapter(Stamp)


def _digest(key: object, body: str) -> str:
    return hashlib.sha256(f"{key}\n{body}".encode()).hexdigest()


@contextmanager
def _opened(path: Path, mode: str) -> Iterator[sqlite3.Connection]:
    """A connection whose commits are on the disk when they return.

    What the system refuses is an OSError, what is wrong with the file a LedgerError.
    """
    if mode != "rwc":
        _refuse_foreign(path)
    try:
        address = f"{path.absolute().as_uri()}?mode={mode}"
        # another process may be reading: it is done in no time
        with closing(sqlite3.connect(address, uri=True, timeout=60)) as database:
            # a commit ends with the journal taken away, which FULL does not flush
            database.execute("PRAGMA synchronous = EXTRA")
            database.execute("PRAGMA trusted_schema = OFF")
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
            tables = database.execute("SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL")
            if mode != "rwc" and tuple(sql for (sql,) in tables) != SCHEMA:
                raise LedgerError("it has other tables")
            yield database
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "")  # none where Python can't decode a text
        if name.startswith(_REFUSED):
            raise OSError(None, f"{error}", str(path)) from None
        raise LedgerError(str(error)) from None


def _refuse_foreign(path: Path) -> None:
    """Raise LedgerError for what SQLite would wait for, follow out of the store or obey."""
    for beside in ("", "-journal", "-wal", "-shm"):
        file = path.with_name(path.name + beside)
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise LedgerError(f"{file.name} is no file")
    journal = path.with_name(f"{path.name}-journal")
    if journal.is_file() and journal.read_bytes().endswith(SUPER):
        raise LedgerError(f"{journal.name} is not its own")
    if path.is_file():
        with path.open("rb") as opened:
            if opened.read(20)[18:] not in (b"", ROLLBACK):
                raise LedgerError("it is kept in another way")


_REFUSED = tuple(
    f"SQLITE_{name}"
    for name in ("BUSY", "CANTOPEN", "FULL", "IOERR", "LOCKED", "NOMEM", "PERM", "READONLY", "AUTH")
)
