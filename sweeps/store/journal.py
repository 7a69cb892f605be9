"""What a refined run has simulated, until its blocks are written: one file after another.

The cells of a batch lie all over the grid. So they are added in files of their own, and no block is
written twice: a kill never costs what was simulated before. A file begins with the SHA-256 of the
store's record and of its rest, an uncompressed NPZ of cells and variables. The ledger has the
number of files, so that a deleted one is missed.
"""

import hashlib
import io
import itertools
import os
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sweeps.store import fsync
from sweeps.store.ledger import Ledger

NAME = re.compile(r"simulated\.(\d{1,9})")
CELLS = "cells"
MOST_MISSING = 100  # that are named: a flipped bit in the ledger may count a thousand million
_DIGEST = hashlib.sha256().digest_size

Simulated = tuple[np.ndarray, dict[str, np.ndarray]]  # numbers of cells, variable -> its values


@dataclass(frozen=True)
class Journal:
    """The files of a store, numbered from 1."""

    path: Path  # of the store
    record: str  # SHA-256 of its sweep
    ledger: Ledger | None  # None in format 1, which has no journal

    def files(self) -> list[Path]:
        """The files, by number."""
        found = ((NAME.fullmatch(file.name), file) for file in self.path.iterdir())
        return [file for _, file in sorted((int(m[1]), file) for m, file in found if m)]

    def missing(self) -> list[str]:
        """The names of at most MOST_MISSING files that somebody has deleted. Raises LedgerError."""
        there = {file.name for file in self.files()}
        counted = (self._file(i + 1).name for i in range(self._count()))
        return list(itertools.islice((name for name in counted if name not in there), MOST_MISSING))

    def append(self, cells: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Add cells and their values. After the return a power cut loses none. Raises OSError."""
        body = io.BytesIO()
        np.savez(body, allow_pickle=False, **{CELLS: cells}, **values)
        content = body.getvalue()
        free = (self._file(n) for n in itertools.count(1))
        path = next(file for file in free if not os.path.lexists(file))
        fsync.write({path: self._digest(content) + content})
        if self.ledger:  # after the file: a kill between the two loses nothing
            self.ledger.count_files(max(self._count(), int(path.suffix[1:])))

    def read(self) -> Iterator[Simulated]:
        """What the files have; one that is damaged is left out."""
        for file in self.files():
            if (found := self._read(file)) is not None:
                yield found

    def damaged(self) -> list[Path]:
        """The files that are not as they were written."""
        return [file for file in self.files() if self._read(file) is None]

    def clear(self) -> None:
        """Delete the files: each block has its values. Raises OSError."""
        if self.ledger:
            self.ledger.count_files(0)
        for file in self.files():
            file.unlink()
        fsync.sync(self.path)

    def _count(self) -> int:
        """The number of files that must be there."""
        return self.ledger.files() if self.ledger else 0

    def _file(self, number: int) -> Path:
        return self.path / f"simulated.{number}"

    def _read(self, file: Path) -> Simulated | None:
        if file.is_symlink() or not file.is_file():
            return None
        whole = file.read_bytes()
        digest, content = whole[:_DIGEST], whole[_DIGEST:]
        if digest != self._digest(content):
            return None
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                values = {name: arrays[name] for name in arrays.files}
        except (ValueError, KeyError, OSError, zipfile.BadZipFile):
            return None
        return values.pop(CELLS), values

    def _digest(self, content: bytes) -> bytes:
        return hashlib.sha256(self.record.encode() + content).digest()
