"""Merge the parts of a sweep, one for each shard, into one store: whole, or not at all.

All that can be checked without reading the blocks is checked before anything is written. The store
is then built beside its name, as a new one is: metadata and coordinates of the first part, the
files of each block, compared with their checksums, and the rows. A file is linked, and takes no
more space, where the file system has hard links: no program of ours changes a file in place.
"""

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sweeps.plan.shard import Shard
from sweeps.provenance import IDENTITY, unlike
from sweeps.spec.mistakes import SweepError, command
from sweeps.store import fsync
from sweeps.store.commit import now, write_checksum
from sweeps.store.create import build, refuse_existing
from sweeps.store.format import OF_RUN
from sweeps.store.ledger import DONE, LEDGER, Ledger, Row, intact
from sweeps.store.lock import unchanged
from sweeps.store.opening import Counts, Store, open_store

PROGRAM = ("format", "metrics_definition", *IDENTITY)  # attributes in which all parts agree
TOGETHER = 16  # blocks at a time: an fsync takes 3 ms, also of a file that is on the disk
SEVERAL = ("device", "revision", "fic_jax")  # attributes in which parts may differ

Parts = dict[Shard, Store]


def merge(
    paths: Sequence[Path],
    out: Path | None = None,
    incomplete: bool = False,
    on_block: Callable[[int, int], None] = lambda done, blocks: None,
) -> Store:
    """Make the store of all parts, at `out` or beside the first part.

    If `incomplete`, shards and blocks may be missing; `resume` runs them. `on_block` is called
    after each block with the number of blocks that are done, and that there are. Raises SweepError
    for parts that are missing, unfinished, running, damaged, or of different runs; OSError.
    """
    parts = _parts(paths)
    shard, first = next(iter(parts.items()))
    path = out or shard.whole(first.path)
    refuse_existing(path, first.grid.sweep)
    for part in parts.values():
        with unchanged(part.path):
            part.check_done()
            part.check_metadata()
    if not incomplete and (problem := _incomplete(parts, shard.whole(first.path))):
        raise SweepError(problem)
    return build(path, lambda partial: _write(partial, parts, on_block))


def _parts(paths: Sequence[Path]) -> Parts:
    """The parts in the order of their shards. Raises SweepError unless they are of one run."""
    parts: Parts = {}
    for path in paths:
        part = open_store(path)
        shard = part.grid.shard
        if shard is None:
            raise SweepError(f"{path}: is the store of a whole sweep, not of a shard")
        if parts:
            _refuse_different(part, next(iter(parts.values())))
        if shard in parts:
            raise SweepError(f"{path}: is shard {shard}, and so is {parts[shard].path}; name one")
        parts[shard] = part
    return dict(sorted(parts.items(), key=lambda item: item[0].k))


def _refuse_different(part: Store, first: Store) -> None:
    """Refuse parts of two sweeps, of two divisions of one, or of two programs."""
    found, wanted = part.group.attrs.asdict(), first.group.attrs.asdict()
    other = [word for key, word in OF_RUN.items() if found.get(key) != wanted.get(key)]
    other += ["number of shards"] if _n(part) != _n(first) else []
    if other:
        what = ", ".join(other)
        raise SweepError(f"{part.path}: was begun with another {what} than {first.path}")
    if differing := unlike(PROGRAM, found, wanted):
        what = "; ".join(differing)
        raise SweepError(f"{part.path}: was made by another program than {first.path}: {what}")


def _n(part: Store) -> int:
    return part.grid.shard.n if part.grid.shard else 1


def _incomplete(parts: Parts, whole: Path) -> str:
    """Which shards are missing or unfinished, and what runs the first of each; empty if none."""
    n, first = next(iter(parts)).n, next(iter(parts.values()))
    missing = sorted(set(range(1, n + 1)) - {shard.k for shard in parts})
    left = {shard.k: part for shard, part in parts.items() if Counts.of(part).pending}
    says = []
    if missing:
        run = first.run_shard(Shard(missing[0], n), whole)
        says.append(f"{_numbers(missing)} missing ({run} runs {missing[0]})")
    if left:
        k, part = next(iter(left.items()))
        resume = command("resume", part.path)
        says.append(f"{_numbers(list(left))} unfinished ({resume} goes on with {k})")
    rest = "; --incomplete merges what there is"
    return f"{whole}: of {n} shards, {', and '.join(says)}{rest}" if says else ""


def _numbers(numbers: Sequence[int]) -> str:
    """Numbers with their verb, neighbours together: "3 is", "4, 7 to 9 are"."""
    runs: list[list[int]] = []
    for k in numbers:
        if runs and runs[-1][-1] == k - 1:
            runs[-1] = [runs[-1][0], k]
        else:
            runs.append([k])
    texts = [" to ".join(map(str, run)) for run in runs]
    return f"{', '.join(texts)} {'is' if len(numbers) == 1 else 'are'}"


def _write(partial: Path, parts: Parts, on_block: Callable[[int, int], None]) -> None:
    """Write the store of all parts into an empty folder."""
    first, said = next(iter(parts.values())), []
    rows: list[Row] = []
    names = [file.path for file in first.check_metadata()]
    for name in names:
        (partial / name).parent.mkdir(exist_ok=True)
        _take(first.path / name, partial / name)
    ledger = Ledger.create(partial / LEDGER)
    with ThreadPoolExecutor(TOGETHER) as pool:
        for part in parts.values():
            with unchanged(part.path):
                own = part.rows()
                taken = pool.map(lambda row, part=part: _take_block(partial, part, row), own)
                for done, _ in enumerate(taken, len(rows) + 1):
                    on_block(done, first.grid.n_blocks)
            ledger.insert(own)
            rows += own
            said.append(_said(part, own))
    done = sum(row.outcome == DONE for row in rows) == first.grid.n_blocks
    record = _record(first, said, done)
    # by renaming: the file that it replaces may be linked, and the part's must stay as it is
    fsync.write({partial / "zarr.json": record})
    ledger.insert_metadata((name, (partial / name).read_bytes()) for name in names)
    write_checksum(ledger)
    for folder in sorted({(partial / name).parent for name in names}):
        fsync.sync(folder)


def _take_block(partial: Path, part: Store, row: Row) -> None:
    """Check the files of a block, and link or copy them. Raises SweepError if one is damaged."""
    for file, checksum in part.files(row):
        place = file.relative_to(part.path)
        try:
            good = intact(file, checksum)
        except OSError as error:
            raise SweepError(f"{file}: can't be read: {error.strerror}") from None
        if not good:
            raise part.damaged(f"{place} is not as it was written")
        _take(file, partial / place)


def _take(file: Path, target: Path) -> None:
    """Link a file, or copy it: to another file system, or on one that has no hard links.

    The content is on the disk first, also if somebody has copied the part here.
    """
    fsync.sync(file)
    try:
        os.link(file, target)
    except OSError:
        shutil.copyfile(file, target)
        fsync.sync(target)


def _said(part: Store, rows: Sequence[Row]) -> dict[str, str]:
    """What the merged store says of a part."""
    attributes = part.group.attrs
    end = max((row.at for row in rows), default="")
    said = {key: str(attributes[key]) for key in ("shard", "start", *SEVERAL)}
    return said | {"end": end}


def _record(first: Store, said: Sequence[Mapping[str, str]], done: bool) -> bytes:
    """The record of the merged store, from that of its first part."""
    record = json.loads((first.path / "zarr.json").read_bytes())
    attributes = record["attributes"]
    del attributes["shard"], attributes["shard_rule"]
    attributes.pop("end", None)
    for key in SEVERAL:
        attributes[key] = ", ".join(dict.fromkeys(part[key] for part in said))
    attributes |= {"start": min(part["start"] for part in said), "merged": now()}
    attributes |= {"end": max(part["end"] for part in said)} if done else {}
    attributes["parts"] = json.dumps(said)  # a text: NetCDF knows no tables
    return json.dumps(record, indent=2).encode()
