"""What a refined run has simulated, until its blocks are written: one file after another.

The cells of a batch lie all over the grid. So they are added in files of their own, and no block is
written twice: a kill never costs what was simulated before. A file begins with the SHA-256 of the
store's record and of its rest, an uncompressed NPZ of cells and variables.
"""

import hashlib
import io
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sweeps.store import fsync

NAME = re.compile(r"simulated\.(\d{1,9})")
CELLS = "cells"
_DIGEST = hashlib.sha256().digest_size

Simulated = tuple[np.ndarray, dict[str, np.ndarray]]  # numbers of cells, variable -> its values


@dataclass(frozen=True)
class Journal:
    """The files of a store, in the order in which they were written."""

    path: Path  # of the store
    record: str  # SHA-256 of its sweep

    def files(self) -> list[Path]:
        """The files, the oldest first."""
        found = ((NAME.fullmatch(file.name), file) for file in self.path.iterdir())
        return [file for _, file in sorted((int(m[1]), file) for m, file in found if m)]

    def append(self, cells: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Add cells and their values. After the return a power cut loses none. Raises OSError."""
        body = io.BytesIO()
        np.savez(body, allow_pickle=False, **{CELLS: cells}, **values)
        content = body.getvalue()
        last = max((int(file.suffix[1:]) for file in self.files()), default=0)
        path = self.path / f"simulated.{last + 1}"
        fsync.write({path: self._digest(content) + content})

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
        for file in self.files():
            file.unlink()
        fsync.sync(self.path)

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
