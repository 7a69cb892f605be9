"""A digest of source files: part of the name of compiled code in the compile cache."""

import hashlib
import time
from pathlib import Path

LOADED = time.time()  # s; this process has read source files before


def digest(folder: Path) -> str | None:
    """SHA-256 of a package's source files; None if one has changed since this process began."""
    hashed = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        if path.stat().st_mtime > LOADED:
            return None
        hashed.update(f"{path.relative_to(folder)}\0".encode() + path.read_bytes())
    return hashed.hexdigest()
