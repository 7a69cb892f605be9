"""Whether a store is as it was written, file by file, and making it so again."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sweeps.provenance import KEPT
from sweeps.runner import Tell, run
from sweeps.spec.mistakes import SweepError
from sweeps.store import fsync as durable
from sweeps.store import ledger as ledgers
from sweeps.store import lock as owner
from sweeps.store.commit import changing, seal
from sweeps.store.format import lay_out
from sweeps.store.ledger import Fixed, Ledger, LedgerError, Row, intact
from sweeps.store.opening import Store, as_written, open_store, plain

OWN = {ledgers.NAME, f"{ledgers.NAME}-journal", ledgers.SEAL, owner.NAME}


@dataclass(frozen=True)
class Problem:
    """One thing in a store that is not as it was written."""

    what: str  # the file, as a path in the store
    how: str
    block: int | None = None  # what it is a part of, if it is computed
    foreign: bool = False  # nothing of ours: it stays


@dataclass(frozen=True)
class Report:
    """What was looked at, and what was found."""

    blocks: int | None  # None: they can't be told before the metadata is mended
    files: int
    problems: tuple[Problem, ...]
    planned: int = 0  # blocks of the whole sweep

    @property
    def frame(self) -> list[Problem]:
        """What is wrong with the ledger, the metadata and the coordinates."""
        return [p for p in self.problems if p.block is None and not p.foreign]

    @property
    def bad_blocks(self) -> list[int]:
        """Blocks to be computed again."""
        return sorted({p.block for p in self.problems if p.block is not None})


def verify(path: Path) -> Report:
    """Read every file of a store and compare it with the ledger; changes nothing.

    Raises SweepError where there is no store, or one of a format without a ledger.
    """
    ledger = _ledger_of(path)
    problems = list(_wrong_ledger(ledger))
    rows, fixed = ledger.good()
    whole = not problems
    problems += [problem for one in fixed for problem in _wrong_fixed(path, one)]
    links = [Problem(name, "is a link") for name in _folders(fixed) if (path / name).is_symlink()]
    problems += links
    if links or any(problem.what.endswith("zarr.json") for problem in problems):
        return Report(None, len(fixed), tuple(problems))
    store = open_store(path)
    problems += [problem for row in rows for problem in _wrong_block(store, row)]
    problems += _lost(store, rows)
    if whole:
        problems += _extra(store, fixed)
    n_files = len(fixed) + sum(len(row.files) for row in rows)
    return Report(len(rows), n_files, tuple(problems), store.grid.n_blocks)


def mend_frame(path: Path) -> None:
    """Bring back what the blocks hang in: the ledger, the metadata, the coordinates.

    Rows that a damaged ledger still has whole are kept; blocks whose rows are lost are to be
    computed again. Raises SweepError where too much is lost, OSError.
    """
    ledger = _ledger_of(path)
    with owner.owning(path), tempfile.TemporaryDirectory() as folder:
        rows, fixed = ledger.good()
        root = next((one.content for one in fixed if one.path == "zarr.json"), None)
        if root is not None:
            _restore(path, "zarr.json", root)
        for place in (path / name for name in _folders(fixed)):
            if place.is_symlink() or place.is_file():
                place.unlink()  # nothing is written through a link
        fresh = Path(folder) / "fresh"
        _lay_out_again(path, fresh)
        for one in Ledger(fresh / ledgers.NAME).fixed():
            if one.path != "zarr.json" and not intact(path / one.path, one.stamp):
                _restore(path, one.path, (fresh / one.path).read_bytes())
        if any(_wrong_ledger(ledger)):
            again = Ledger(fresh / ledgers.NAME)
            again.fix([("zarr.json", (path / "zarr.json").read_bytes())])
            again.add(rows)
            # first: a journal of the old ledger would be played back into the new one
            ledger.path.with_name(f"{ledgers.NAME}-journal").unlink(missing_ok=True)
            _restore(path, ledgers.NAME, again.path.read_bytes())
        _free(path / ledgers.SEAL)
        seal(ledger)


def recompute(store: Store, blocks: list[int], tell: Tell) -> list[int]:
    """Run blocks again; returns those that came out other than the ledger has them."""
    assert store.ledger is not None
    before = {row.block: row.files for row in store.rows() if row.block in set(blocks)}
    with changing(store) as (writer, _):
        writer.ledger.forget(blocks)
        for block in blocks:
            for name in store.variables:
                _free(store.file(name, block))
    run(store, tell, blocks)
    after = {row.block: row.files for row in store.rows()}
    return [b for b, files in before.items() if b in after and after[b] != files]


def _ledger_of(path: Path) -> Ledger:
    """The ledger of what is a store, be it damaged."""
    ledger = Ledger(path / ledgers.NAME)
    if not os.path.isfile(ledger.path) or ledger.path.is_symlink():  # False for a name too long
        store = open_store(path)
        if store.ledger is None:
            raise SweepError(f"{path}: has format 1, whose blocks have no checksums in a ledger")
    return ledger


def _wrong_ledger(ledger: Ledger) -> Iterator[Problem]:
    if not ledger.path.is_file():
        yield Problem(ledgers.NAME, "is missing")
        return
    try:
        ledger.check()
    except LedgerError as error:
        yield Problem(ledgers.NAME, f"is damaged: {error}")


def _wrong_fixed(path: Path, one: Fixed) -> Iterator[Problem]:
    if not as_written(path, one):
        yield Problem(one.path, _how(path / one.path))


def _wrong_block(store: Store, row: Row) -> Iterator[Problem]:
    if not 0 <= row.block < store.grid.n_blocks or set(row.files) != set(store.variables):
        yield Problem(ledgers.NAME, f"is damaged: block {row.block} is none of this sweep")
        return
    for name, stamp in row.files.items():
        file = store.file(name, row.block)
        if not intact(file, stamp):
            yield Problem(str(file.relative_to(store.path)), _how(file), row.block)


def _lost(store: Store, rows: list[Row]) -> Iterator[Problem]:
    """Blocks of a store that was finished and whose ledger lost them."""
    if "end" in store.group.attrs:
        there = {row.block for row in rows}
        for index in sorted(set(range(store.grid.n_blocks)) - there):
            yield Problem(ledgers.NAME, f"has no row of block {index}", index)


def _extra(store: Store, fixed: list[Fixed]) -> Iterator[Problem]:
    """Whatever is not part of the store. A block without a row is: it was under way."""
    known = {one.path for one in fixed} | OWN | set(_folders(fixed))
    n = store.grid.n_blocks
    blocks = {store.file("status", index).name for index in range(n)}
    for file in sorted(store.path.glob("**/*")):
        name = file.relative_to(store.path)
        whole = file.with_name(file.name.removesuffix(durable.PARTIAL)).relative_to(store.path)
        ours = len(name.parts) == 2 and name.parts[0] in store.variables and whole.name in blocks
        if not (whole.as_posix() in known or ours) or not plain(file):
            yield Problem(name.as_posix(), "is not part of the store", foreign=True)


def _folders(fixed: list[Fixed]) -> list[str]:
    """The folders of a store's arrays."""
    return sorted({one.path.partition("/")[0] for one in fixed if "/" in one.path})


def _how(file: Path) -> str:
    return "is not as it was written" if file.exists() else "is missing"


def _lay_out_again(path: Path, fresh: Path) -> None:
    """The store as it was before its first block, from its record."""
    store = open_store(path)
    attributes = store.group.attrs.asdict()
    lay_out(fresh, store.grid, {key: attributes[key] for key in KEPT if key in attributes})


def _restore(path: Path, name: str, content: bytes) -> None:
    """Put a file back; what stands in its place goes."""
    place = path / name
    _free(place)
    place.parent.mkdir(exist_ok=True)
    durable.write({place: content})


def _free(place: Path) -> None:
    """Take away a link or a folder where a file belongs."""
    if place.is_symlink():
        place.unlink()
    elif place.is_dir():
        shutil.rmtree(place)
