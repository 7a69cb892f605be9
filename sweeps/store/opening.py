"""Open a store, count what is done, read it."""

import json
import os
import re
import stat
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import zarr

from fic_jax import display
from sweeps.plan.grid import Grid, cells_of
from sweeps.plan.shard import RULE, Shard
from sweeps.spec.mistakes import SweepError, command, printable
from sweeps.spec.overrides import override
from sweeps.spec.reading import validate
from sweeps.spec.types import Sweep
from sweeps.store import format as store_format
from sweeps.store.format import (
    AT_END,
    BUDGET_LEVEL,
    DEFINITION,
    DEFINITIONS,
    DIVERGED,
    FORMAT,
    NOT_RUN,
    OK,
    STATUS,
    TRUSTED,
)
from sweeps.store.journal import Journal
from sweeps.store.ledger import (
    DONE,
    LEDGER,
    SET_ASIDE,
    Checksum,
    Ledger,
    LedgerError,
    MetadataFile,
    Row,
    intact,
)
from sweeps.store.place import before_extension, place_of_store

if TYPE_CHECKING:
    import xarray as xr

LARGEST_RECORD = 20_000_000  # bytes of a store's zarr.json: a sweep file has at most a million
NO_FILE = -1  # instead of a size
_BLOCK = re.compile(r"c(\.\d+)*")  # the name of a block's file

Entry = TypeVar("Entry")
CODECS = {"bytes", "blosc", "crc32c", "vlen-utf8"}


@dataclass(frozen=True, repr=False)
class Store(display.Displayed):
    """An open store: where it is, its plan, its arrays, its ledger."""

    path: Path
    grid: Grid
    group: zarr.Group
    ledger: Ledger | None  # None in format 1

    def _table(self) -> display.Table:
        sweep = self.grid.sweep
        dims = " x ".join(f"{name} {n}" for name, n in self.grid.dims.items())
        try:
            cells = [display.Row(name, f"{n:,}") for name, n in Counts.of(self).cells.items() if n]
        except Exception as error:  # damaged or gone: the line says it
            cells = [display.Row("cells", str(error).splitlines()[0])]
        rows = [
            display.Row("sweep", f"{sweep.name}: {dims}, {self.dtype}"),
            *cells,
            *self._budget(),
            display.Row(
                "variables", textwrap.shorten(", ".join(self.variables), 70, placeholder=" ...")
            ),
        ]
        return display.Table(f"Store {self.path}; xarray.open_zarr(store.path) reads it", rows)

    def _budget(self) -> Iterator[display.Row]:
        if BUDGET_LEVEL in self.group.attrs:
            yield display.Row("budget", f"ended it at level {self.group.attrs[BUDGET_LEVEL]}")

    @property
    def dtype(self) -> str:
        """Precision of the metrics, `float32` or `float64`."""
        return str(self.group.attrs["dtype"])

    @property
    def form(self) -> int:
        """The format that it was written in."""
        return cast(int, self.group.attrs["format"])

    @property
    def definition(self) -> str:
        """The definition of its metrics, a key of DEFINITIONS."""
        return str(self.group.attrs.get("metrics_definition", "samples"))

    @cached_property
    def variables(self) -> list[str]:
        """The variables, in the order they are written."""
        return store_format.variable_names(self.grid.sweep, self.form)

    @property
    def journal(self) -> Journal:
        """What a refined run has simulated, until its blocks are written."""
        return Journal(self.path, str(self.group.attrs["sweep_sha256"]), self.ledger)

    def array(self, name: str) -> zarr.Array[Any]:
        """A variable or a coordinate on the disk."""
        return self._arrays[name]

    def file(self, variable: str, block: int) -> Path:
        """The file of a block of a variable."""
        return self.path / variable / ".".join(["c", *map(str, self.grid.place(block))])

    def files(self, row: Row) -> Iterator[tuple[Path, Checksum]]:
        """The files of a block and their checksums."""
        return ((self.file(name, row.block), checksum) for name, checksum in row.files.items())

    def rows(self) -> list[Row]:
        """The ledger's rows of blocks. Raises SweepError if the ledger is damaged."""
        if self.ledger is None:
            return list(self._rows_of_format_1())
        rows = self._read(self.ledger.rows)
        for row in rows:
            if not self.grid.owns(row.block) or set(row.files) - set(self.variables):
                raise self.damaged(f"{LEDGER} is damaged: it has a block {row.block}")
        return rows

    def check_definition(self) -> None:
        """Raise SweepError if this program computes metrics of another definition."""
        if self.definition != DEFINITION:
            raise SweepError(
                f"{self.path}: its metrics are {DEFINITIONS[self.definition]}, this program's are "
                f"{DEFINITIONS[DEFINITION]}: it can't be continued; "
                f"{self.run_again()} runs its sweep again"
            )

    def run_again(self) -> str:
        """The command that runs its sweep, or its shard, again, into another store."""
        shard = self.grid.shard
        if shard:
            again = f"{shard.whole(self.path).stem}-again.zarr"
            return self.run_shard(shard, Path(again))
        return command("run", self.path, "--out", Path(f"{self.path.stem}-again.zarr"))

    def run_shard(self, shard: Shard, whole: Path) -> str:
        """The command that runs a shard of its sweep, as a part that `merge` takes with this one.

        `whole` is the store of all parts.
        """
        attributes = self.group.attrs
        options = {
            "--shard": shard,
            "--chunk": attributes["block_cells"],
            "--precision": self.dtype.removeprefix("float"),
            "--device": attributes["platform"],
            "--out": whole,
        }
        return command("run", self.path, *(word for pair in options.items() for word in pair))

    def sweep_again(self, overrides: Sequence[str] = ()) -> Sweep:
        """Its sweep for a new run, changed as by `--set`. Raises SweepError for a mistake."""
        estimate, precision = self.grid.sweep.error_estimate, int(self.dtype.removeprefix("float"))
        raw = json.loads(self.grid.sweep.record())
        raw |= {"error_estimate": estimate, "precision": precision}
        for assignment in overrides:
            override(raw, assignment)
        return validate(raw, str(self.path))

    def damaged(self, what: str) -> SweepError:
        """The error for a store that changed since it was written."""
        repair = command("verify", self.path, "--repair")
        return SweepError(f"{self.path}: {what}; {repair} mends it")

    def check_done(self) -> None:
        """Check that each file of a block with a row is a file of its recorded size.

        Raises SweepError: Zarr would read a missing one as fill values, and a foreign one could
        fill the memory.
        """
        self._other_files(self.rows())

    def _other_files(self, rows: list[Row]) -> dict[str, dict[str, int]]:
        """Variable -> file -> size, of all that is no file of a block with a row."""
        # `status` first: a run writes it last, perhaps during this scan; `rows` are older
        sizes = {name: _sizes(self.path / name) for name in reversed(self.variables)}
        files = [file for row in rows for file in self.files(row)]
        wrong = [f for f, known in files if sizes[f.parent.name].pop(f.name, -1) != known.size]
        if wrong:
            first = wrong[0].relative_to(self.path)
            more = f" and {len(wrong) - 1:,} more files" if len(wrong) > 1 else ""
            raise self.damaged(f"lacks {first}{more}, of finished blocks")
        return sizes

    def check_files(self) -> None:
        """Raise SweepError as `check_done` does, and for a block that is half written."""
        if self.ledger is None:
            return
        rows = self.rows()
        sizes = self._other_files(rows)
        rest = {(name, file) for name, found in sizes.items() for file in found}
        if not rest:  # files of blocks without a row, or of nobody
            return
        done, variables = {row.block for row in rows}, self.variables
        blocks = [i for i in range(self.grid.n_blocks) if i not in done]
        for block in blocks:
            file = self.file("status", block).name
            there = [name for name in variables if (name, file) in rest]
            for name in there:
                if sizes[name][file] == NO_FILE:
                    raise SweepError(f"{self.path / name / file}: is no file; remove it")
            if "status" in there and len(there) < len(variables):
                half = f"a power cut left blocks half written; {command('resume', self.path)}"
                raise SweepError(f"{self.path}: {half} writes them")

    def check_metadata(self) -> list[MetadataFile]:
        """The files of metadata and coordinates; raises SweepError if one was changed."""
        if self.ledger is None:
            return []
        files = self._read(self.ledger.metadata)
        for file in files:
            if not as_written(self.path, file):
                raise self.damaged(f"{file.path} is not as it was written")
        return files

    def _read(self, query: Callable[[], Iterable[Entry]]) -> list[Entry]:
        """Entries of the ledger. Raises SweepError if it is damaged."""
        if not (self.path / LEDGER).is_file():
            raise self.damaged(f"{LEDGER} is missing")
        try:
            return list(query())
        except LedgerError as error:
            raise self.damaged(f"{LEDGER} is damaged: {error}") from None

    @cached_property
    def _arrays(self) -> dict[str, zarr.Array[Any]]:
        return dict(self.group.arrays())

    def _rows_of_format_1(self) -> Iterator[Row]:
        """A row for each block whose cells all have a status."""
        for index, block in enumerate(self.grid.blocks()):
            status = np.asarray(self.array("status")[block])
            if np.all(status != NOT_RUN):
                _, ok, diverged, failed = np.bincount(status.ravel(), minlength=4).tolist()
                trusted = 0
                if self.grid.sweep.error_estimate:
                    trusted = int(np.sum(np.asarray(self.array("trusted")[block]) == TRUSTED))
                yield Row(index, DONE, ok, diverged, failed, trusted)


@dataclass(frozen=True)
class Counts:
    """How far a store is."""

    cells: dict[str, int]  # by status; of a shard, its own
    trusted: dict[str, int]  # by metric; empty without error estimates
    pending: list[int]  # blocks to run, in storage order
    set_aside: list[Row]
    unfinished: dict[int, Row]  # pending blocks that have a row

    @property
    def done(self) -> int:
        """Cells that were computed."""
        return self.cells["ok"] + self.cells["diverged"]

    @classmethod
    def of(cls, store: Store) -> "Counts":
        """Count the rows of a store's ledger. Raises SweepError if the ledger is damaged."""
        rows = store.rows()
        cells = {name: sum(getattr(row, name) for row in rows) for name in list(STATUS)[OK:]}
        done = {row.block for row in rows if row.outcome == DONE}
        trusted = {
            metric: sum(_trusted(row, metric) for row in rows)
            for metric in store_format.judgements(store.grid.sweep, store.form).values()
        }
        if store.grid.sweep.refine:  # a finished block has no other cells than these
            near = sum(cells_of(store.grid.block(block)) for block in done)
            cells["nearby"] = near - cells["ok"] - cells["diverged"]
            for numbers, values in store.journal.read():
                elsewhere = ~np.isin(store.grid.block_of(numbers), list(done))
                status = values["status"][elsewhere]
                cells["ok"] += int(np.sum(status == OK))
                cells["diverged"] += int(np.sum(status == DIVERGED))
                for metric in trusted:
                    flag = values[f"{metric}_trusted"][elsewhere]
                    trusted[metric] += int(np.sum((flag == TRUSTED) & (status == OK)))
        cells = {"not run": store.grid.own_cells - sum(cells.values())} | cells
        return cls(
            cells,
            trusted,
            pending=[i for i in store.grid.own if i not in done],
            set_aside=[row for row in rows if row.outcome == SET_ASIDE],
            unfinished={row.block: row for row in rows if row.outcome != DONE},
        )


def _trusted(row: Row, metric: str) -> int:
    return row.trusted if isinstance(row.trusted, int) else row.trusted.get(metric, 0)


def open_store(path: Path) -> Store:
    """Open a store and rebuild its plan from the record.

    The hash of the record is checked; the sweep was validated when the store was made. Raises
    SweepError if `path` is no store or is not as a run writes it.
    """
    path = place_of_store(path)
    if reason := _no_store(path):
        raise SweepError(f"{path}: {reason}")
    try:
        store = _read(path)
    except SweepError:
        raise
    except OSError as error:
        raise SweepError(f"{path}: can't be read: {error.strerror or error}") from None
    except Exception as error:  # whatever zarr and pydantic raise for a foreign file
        reason = printable(" ".join(str(error).split())[:150])
        if _can_be_restored(path):
            reason += f"; {command('verify', path, '--repair')} restores its metadata"
        raise SweepError(f"{path}: is no result store of fic-sweep: {reason}") from None
    if store.ledger is None and any(not plain(entry) for entry in path.rglob("*")):
        raise SweepError(f"{path}: has a link in it; a store is one folder")
    return store


def _read(path: Path) -> Store:
    """The store that a zarr.json describes. Raises an error of any kind if it describes none."""
    if os.path.getsize(path / "zarr.json") > LARGEST_RECORD:
        raise ValueError("its zarr.json is too large")
    if "consolidated_metadata" not in json.loads((path / "zarr.json").read_bytes()):
        raise ValueError("its metadata is not in one file")  # Zarr would scan the folders
    group = zarr.open_group(path, mode="r", zarr_format=3)
    attributes: dict[str, Any] = group.attrs.asdict()
    written, record = attributes["format"], attributes["sweep"]
    if written not in range(1, FORMAT + 1):
        raise SweepError(f"{path}: has format {written}; this program reads up to {FORMAT}")
    definition = attributes.get("metrics_definition", "samples")
    if (definition == "samples") != (written < 3) or definition not in DEFINITIONS:
        raise ValueError(f"format {written} with metrics of the definition {definition}")
    if store_format.sha256(record) != attributes["sweep_sha256"]:
        raise ValueError("its sweep record differs from the one that began it")
    # the estimate is no part of the record, and the oldest stores have no attribute for it
    estimate = bool(attributes.get("error_estimate"))
    sweep = Sweep.model_validate(json.loads(record) | {"error_estimate": estimate})
    chunk = int(str(attributes["block_cells"]))
    if chunk < 1 or attributes["dtype"] not in ("float32", "float64"):
        raise ValueError(f"block_cells {chunk}, dtype {attributes['dtype']}")
    ledger = Ledger(path / LEDGER) if written > 1 else None
    shard = Shard.parse(str(attributes["shard"])) if "shard" in attributes else None
    if shard and attributes.get("shard_rule") != RULE:
        raise SweepError(
            f"{path}: is shard {shard} of another version of fic-sweep, which divides the blocks "
            "in another way; only that one can read it"
        )
    store = Store(path, Grid(sweep, chunk, shard), group, ledger)
    for array in store_format.arrays(store.grid, store.dtype, store.form):
        if not _matches(store, array):
            raise ValueError(f"its variable {array['name']} is not the one of its sweep")
    return store


EXPORTED = (".nc", ".csv", ".parquet")  # suffixes of `fic-sweep export`


def _no_store(path: Path) -> str:
    """Why a path is no store, and what helps; empty if it has a zarr.json."""
    try:
        if stat.S_ISREG(os.stat(path / "zarr.json").st_mode):
            return ""
        why = "its zarr.json is no file"
    except NotADirectoryError:
        why = "it is a file, and a store is a folder"
        if path.suffix == ".toml":
            why = f"it is a sweep file; {command('run', path)} makes a store of it"
        elif path.suffix in EXPORTED:
            why = "it is an exported file; name the store that it was made from, a folder"
    except FileNotFoundError:
        why = "there is nothing of this name"
        if os.path.isdir(path):
            inside = ", ".join(sorted(str(file.parent) for file in path.glob("*/zarr.json")))
            why = f"it has no zarr.json{inside and f'; in it are the stores {inside[:200]}'}"
        elif os.path.isdir(before_extension(path)):
            why = f"its extension was cut short; {command('resume', path)} finishes it"
    except OSError as error:  # no permission, a name that is too long, a loop of links
        return f"can't be read: {error.strerror}"
    if _can_be_restored(path):
        why = f"its zarr.json is lost; {command('verify', path, '--repair')} restores it"
    return f"is no result store: {why}"


def _can_be_restored(path: Path) -> bool:
    """Whether the ledger has another zarr.json than the one in place."""
    _, files = Ledger(path / LEDGER).undamaged()
    return any(f.path == "zarr.json" and f.content and not as_written(path, f) for f in files)


def _matches(store: Store, expected: dict[str, Any]) -> bool:
    """Whether an array is as `format.arrays` describes it.

    One from somebody else could need any memory, run any codec, or lie outside the store.
    """
    try:
        array = store.array(expected["name"])
        codecs = cast(Any, array.metadata.to_dict()["codecs"])
        return (
            (array.shape, array.chunks) == (expected["shape"], expected["chunks"])
            and array.dtype == expected["dtype"]
            and {codec["name"] for codec in codecs} <= CODECS
            and not (store.path / expected["name"]).is_symlink()
        )
    except Exception:  # whatever zarr raises for foreign metadata
        return False


def as_written(path: Path, file: MetadataFile) -> bool:
    """Whether a metadata file is as the ledger has it.

    The root's zarr.json may lack what a finished run writes, to the ledger first: a kill may come
    in between.
    """
    place = path / file.path
    if intact(place, file.checksum):
        return True
    if file.path != "zarr.json" or file.content is None or not (plain(place) and place.is_file()):
        return False
    try:
        with place.open("rb") as opened:  # not all of it: it may have any size
            recorded, found = json.loads(file.content), json.loads(opened.read(LARGEST_RECORD))
        ended = [recorded["attributes"].pop(name, None) for name in AT_END]
        return any(ended) and recorded == found
    except (ValueError, KeyError, RecursionError):
        return False


def plain(entry: Path) -> bool:
    """Whether this is a file or a folder: no link, FIFO or device."""
    return not entry.is_symlink() and (entry.is_file() or entry.is_dir())


def _sizes(folder: Path) -> dict[str, int]:
    """Size of each block's file in a folder; NO_FILE for a link, or a FIFO, which would block.

    Other names are of nobody: a desktop, a file server or a backup leaves files anywhere.
    """
    sizes = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if _BLOCK.fullmatch(entry.name):
                    plain = entry.is_file(follow_symlinks=False)
                    sizes[entry.name] = entry.stat().st_size if plain else NO_FILE
    except OSError:  # missing, or another process just renames it
        return {}
    return sizes


def dataset(path: Path) -> "xr.Dataset":
    """The store as a lazy Dataset, its variables in order. Raises SweepError if it is damaged."""
    import xarray as xr  # half a second with pandas; a run needs neither

    store = open_store(path)
    store.check_metadata()
    store.check_files()
    data = xr.open_zarr(store.path, chunks=None)[store.variables]
    # older stores do not say it all
    says = store_format.attributes(store.grid)
    meaning = {"metrics_definition_meaning": DEFINITIONS[store.definition]}
    data.attrs |= {name: says[name] for name in ("held", "held_by_default")}
    return data.assign_attrs({"metrics_definition": store.definition} | meaning)
