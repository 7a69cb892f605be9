"""Compare every file of a store with its ledger; repair the ledger and the metadata.

`sweeps.runner.recompute` repairs blocks.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sweeps.spec.mistakes import SweepError
from sweeps.store import fsync
from sweeps.store.commit import write_checksum
from sweeps.store.create import write_empty
from sweeps.store.journal import NAME as IN_JOURNAL
from sweeps.store.ledger import CHECKSUM, LEDGER, Ledger, LedgerError, MetadataFile, Row, intact
from sweeps.store.lock import LOCK, locked
from sweeps.store.opening import Store, as_written, open_store
from sweeps.store.place import place_of_store

OWN = {LEDGER, f"{LEDGER}-journal", CHECKSUM, LOCK}


@dataclass(frozen=True)
class Problem:
    """One thing that changed since it was written."""

    what: str  # the file, as a path in the store
    how: str
    block: int | None = None  # the block to run again, if that repairs it
    repairable: bool = True


@dataclass(frozen=True)
class Report:
    """What `verify` read, and the problems."""

    blocks: int | None  # None: unknown until the metadata is repaired
    files: int
    problems: tuple[Problem, ...]
    planned: int = 0  # blocks to run in all
    foreign: tuple[str, ...] = ()  # what is not part of the store: harmless, and left by a repair

    @property
    def metadata(self) -> list[Problem]:
        """Problems with the ledger, the metadata and the coordinates."""
        return [p for p in self.problems if p.block is None and p.repairable]

    @property
    def bad_blocks(self) -> list[int]:
        """Blocks to run again."""
        return sorted({p.block for p in self.problems if p.block is not None})


def verify(path: Path) -> Report:
    """Read every file of a store and compare it with the ledger; change nothing.

    Raises SweepError if `path` is no store, or one of a format without a ledger.
    """
    path = place_of_store(path)
    ledger = _ledger_of(path)
    problems = list(_ledger_problems(ledger))
    damaged = bool(problems)
    rows, files = ledger.undamaged()
    for file in files:
        if not as_written(path, file):
            problems.append(Problem(file.path, _how(path / file.path)))
    links = [Problem(name, "is a link") for name in _folders(files) if (path / name).is_symlink()]
    problems += links
    if links or any(problem.what.endswith("zarr.json") for problem in problems):
        return Report(None, len(files), tuple(problems))
    store = open_store(path)
    problems += [problem for row in rows for problem in _block_problems(store, row)]
    gone = [] if damaged else store.journal.missing()
    for name in (*gone, *(file.name for file in store.journal.damaged())):
        how = f"{_how(path / name)}; a run simulates its cells again"
        problems.append(Problem(name, how, repairable=False))
    if "end" in store.group.attrs:  # a finished store has a row for each block
        missing = set(store.grid.own) - {row.block for row in rows}
        problems += [Problem(LEDGER, f"has no row of block {b}", b) for b in sorted(missing)]
    if not damaged:
        problems += _no_files(store, files, {problem.what for problem in problems})
    n_files = len(files) + sum(len(row.files) for row in rows)
    foreign = () if damaged else tuple(foreign_files(store))
    return Report(len(rows), n_files, tuple(problems), len(store.grid.own), foreign)


def repair_metadata(path: Path) -> None:
    """Restore the ledger, the metadata and the coordinates.

    The good rows of a damaged ledger stay; a block whose row is lost must run again. Raises
    SweepError if too much is lost, OSError.
    """
    path = place_of_store(path)
    ledger = _ledger_of(path)
    with locked(path), tempfile.TemporaryDirectory() as folder:
        rows, files = ledger.undamaged()
        for file in files:
            if file.path == "zarr.json" and file.content is not None:
                _restore(path, "zarr.json", file.content)
        for place in (path / name for name in _folders(files)):
            if place.is_symlink() or place.is_file():
                place.unlink()  # we would write through the link
        fresh, store = Path(folder) / "fresh", open_store(path)
        write_empty(fresh, store.grid, {"dtype": store.dtype}, store.form)
        again, recorded = Ledger(fresh / LEDGER), {file.path: file for file in files}
        names = [file.path for file in again.metadata()]
        for fresh_file in again.metadata():
            # the ledger's copy first: another version may have encoded the file differently
            file = recorded.get(fresh_file.path, fresh_file)
            if file.path != "zarr.json" and not intact(path / file.path, file.checksum):
                encoded = (fresh / file.path).read_bytes()
                _restore(path, file.path, encoded if file.content is None else file.content)
        if any(_ledger_problems(ledger)) or not all(as_written(path, file) for file in files):
            again.insert_metadata((name, (path / name).read_bytes()) for name in names)
            again.insert(rows)
            # first: SQLite would play the old ledger's journal back into the new one
            ledger.path.with_name(f"{LEDGER}-journal").unlink(missing_ok=True)
            _restore(path, LEDGER, again.path.read_bytes())
        free(path / CHECKSUM)
        write_checksum(ledger)


def free(place: Path) -> None:
    """Delete a link or a folder that is in the place of a file."""
    if place.is_symlink():
        place.unlink()
    elif place.is_dir():
        shutil.rmtree(place)


def _restore(path: Path, name: str, content: bytes) -> None:
    place = path / name
    free(place)
    place.parent.mkdir(exist_ok=True)
    fsync.write({place: content})


def _ledger_of(path: Path) -> Ledger:
    """The ledger of a store that may be damaged."""
    ledger = Ledger(path / LEDGER)
    file = os.path.isfile(ledger.path) and not ledger.path.is_symlink()
    if not file and open_store(path).ledger is None:
        raise SweepError(f"{path}: has format 1, whose blocks have no checksums in a ledger")
    return ledger


def _ledger_problems(ledger: Ledger) -> Iterator[Problem]:
    if not ledger.path.is_file():
        yield Problem(LEDGER, "is missing")
        return
    try:
        ledger.check()
    except LedgerError as error:
        yield Problem(LEDGER, f"is damaged: {error}")


def _block_problems(store: Store, row: Row) -> Iterator[Problem]:
    if not store.grid.owns(row.block) or set(row.files) != set(store.variables):
        yield Problem(LEDGER, f"is damaged: block {row.block} is none of this sweep")
        return
    for file, checksum in store.files(row):
        if not intact(file, checksum):
            yield Problem(file.relative_to(store.path).as_posix(), _how(file), row.block)


def foreign_files(store: Store) -> list[str]:
    """What is not part of a store, as paths in it: files of a desktop or a file server, notes."""
    files = list(store.ledger.metadata()) if store.ledger else []
    return [name for name, ours in _entries(store, files) if not ours]


def _no_files(store: Store, files: list[MetadataFile], known: set[str]) -> Iterator[Problem]:
    """Links, folders and FIFOs in the place of files; `known` problems are left out."""
    known |= set(_folders(files))
    for name, ours in _entries(store, files):
        entry = store.path / name
        if ours and name not in known and (entry.is_symlink() or not entry.is_file()):
            yield Problem(name, "is no file; remove it", repairable=False)


def _entries(store: Store, files: list[MetadataFile]) -> Iterator[tuple[str, bool]]:
    """Each path in a store, and whether it is a part. The files of a block without a row are."""
    known = {file.path for file in files} | OWN | set(_folders(files))
    blocks = {store.file("status", index).name for index in range(store.grid.n_blocks)}
    for file in sorted(store.path.glob("**/*")):
        name = file.relative_to(store.path).as_posix()
        whole = name.removesuffix(fsync.PARTIAL)
        folder, _, block = whole.partition("/")
        ours = whole in known or bool(IN_JOURNAL.fullmatch(whole))
        yield name, ours or (folder in store.variables and block in blocks)


def _folders(files: list[MetadataFile]) -> list[str]:
    """The folders of a store's arrays."""
    return sorted({file.path.partition("/")[0] for file in files if "/" in file.path})


def _how(file: Path) -> str:
    return "is not as it was written" if file.exists() else "is missing"
