"""Small stores for tests, made without the engine, and what each must contain."""

import asyncio
import json
import shutil
import sqlite3
from concurrent.futures import Future
from contextlib import closing, contextmanager
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from fic_jax import Metrics
from sweeps import runner
from sweeps.plan.grid import Grid, cells_of
from sweeps.spec.reading import parse
from sweeps.store import create as creation
from sweeps.store import extend, verify
from sweeps.store.commit import Writer
from sweeps.store.ledger import DONE, PARTLY, SET_ASIDE, Checksum
from sweeps.store.opening import Counts, open_store

# Five scenarios in blocks of two; the small sweep is the beginning of the whole one.
TEXT = """
name = "tiny"
metrics = ["nmse", "peak_torque"]
[axes]
K0 = [1.0, 2.0, 3.0, 4.0, 5.0]
"""
WHOLE, SMALL = parse(TEXT, "whole"), parse(TEXT.replace(", 4.0, 5.0", ""), "small")


def cheap(grid, block, dtype, cells=slice(None)):
    """Instead of the engine: numbers that follow from K0; K0 = 2 diverges."""
    K0 = np.asarray(grid.params(block).K0, dtype)[cells]
    values = {f.name: K0 * np.asarray(1.5, dtype) for f in fields(Metrics)}
    return Metrics(**values | {"finite": K0 != 2.0}), None


class Inline:
    """Instead of the thread that commits: the same order of calls every time."""

    def __init__(self, _):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def submit(self, function, *args):
        future = Future()
        try:
            future.set_result(function(*args))
        except BaseException as error:
            future.set_exception(error)
        return future


async def at_once(function, *args, **kwargs):
    return function(*args, **kwargs)


ENCODE, ENCODED = Writer._encode, {}


def encoded(writer, index, name, values):
    """Encode each block once."""
    key = (writer.store.grid.shape, index, name, values.tobytes())
    if key not in ENCODED:
        ENCODED[key] = ENCODE(writer, index, name, values)
    return ENCODED[key]


def without_engine(patch):
    """Replace what is slow or threaded: then every run makes the same calls in the same order."""
    patch.setattr(runner, "_compute", cheap)
    patch.setattr(runner, "ThreadPoolExecutor", Inline)
    patch.setattr(Writer, "_encode", encoded)
    patch.setattr(asyncio, "to_thread", at_once)


class Stores:
    """A folder of stores to begin a case with, and the files of each finished sweep.

    `whole` and `small` are finished. `begun`, of the whole sweep, has a block that is done, one
    done in part, and one set aside. In `damaged` the record, a coordinate and the ledger are
    damaged, in `bad` a block.
    """

    def __init__(self, folder):
        self.folder = folder
        run(runner.start(folder / "whole", WHOLE, 2, 32))
        run(runner.start(folder / "small", SMALL, 2, 32))
        self.made_by = runner.provenance(32)
        self.expected = {n: contents(folder / name) for n, name in ((5, "whole"), (3, "small"))}
        shutil.copytree(folder / "small", folder / "begun")
        enlarge(folder / "begun")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(runner, "_compute", lambda *_: 1 / 0)
            runner.run(open_store(folder / "begun"), lambda p: None, only=[2])
        outcomes = [row.outcome for row in open_store(folder / "begun").rows()]
        assert outcomes == [DONE, PARTLY, SET_ASIDE]
        shutil.copytree(folder / "whole", folder / "bad")
        flip(folder / "bad/nmse/c.1", 99)
        shutil.copytree(folder / "whole", folder / "damaged")
        flip(folder / "damaged/zarr.json", 999)
        (folder / "damaged/K0/c.0").unlink()
        with closing(sqlite3.connect(folder / "damaged/ledger.sqlite")) as ledger, ledger:
            ledger.execute("UPDATE blocks SET body = 'x' WHERE block = 1")

    @contextmanager
    def case(self, source=None):
        """The path of a fresh copy of a store, or of none."""
        with TemporaryDirectory(dir=self.folder.parent) as folder:
            path = Path(folder) / "tiny.zarr"
            if source:
                shutil.copytree(self.folder / source, path)
            yield path

    def create(self, path, told=None):
        creation.create(path, Grid(WHOLE, 2), self.made_by | {"start": "now"})

    def sound(self, path, cells=0, recomputed=()):
        """Every row is true, at least `cells` are done, and `verify` finds no problem."""
        store = open_store(path)
        expected, done = self.expected[store.grid.cells], 0
        for row in store.rows():
            for name, checksum in row.files.items():
                file = store.file(name, row.block)
                assert Checksum.of(file.read_bytes()) == checksum, file
                if row.outcome == DONE:
                    assert file.read_bytes() == expected[str(file.relative_to(path))], file
            done += cells_of(store.grid.block(row.block)) if row.outcome == DONE else 0
        assert done >= cells
        problems = verify.verify(path).problems
        assert {problem.block for problem in problems} <= set(recomputed), problems

    def settle(self, path, damaged=False):
        """What a user does after a mishap; the store then has the files of an undisturbed run."""
        extend.recover(path)
        if not path.exists():
            self.create(path)
        if damaged:
            verify.repair_metadata(path)
        if open_store(path).grid.cells == 3:
            enlarge(path)
        run(open_store(path))
        assert contents(path) == self.expected[5]
        assert not verify.verify(path).problems
        assert not Counts.of(open_store(path)).pending
        assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def run(store, tell=lambda progress: None):
    return runner.run(store, tell)


def enlarge(path, told=None):
    extend.extend(open_store(path), WHOLE, "whole")


def flip(file, bit):
    """Flip one bit of a file."""
    content = bytearray(file.read_bytes())
    content[bit // 8 % len(content)] ^= 1 << bit % 8
    file.write_bytes(content)


def contents(path):
    """Every file of a store that must come out the same; of the record all but its times."""
    files = {
        file.relative_to(path).as_posix(): file.read_bytes()
        for file in path.rglob("*")
        if file.is_file() and not file.name.startswith(("ledger.", "owner."))
    }
    record = json.loads(files["zarr.json"])
    for key in ("start", "end", "extended", "merged", "parts"):
        record["attributes"].pop(key, None)
    return files | {"zarr.json": record}


def repaired(path):
    """What `fic-sweep verify --repair` does, after it has found something."""
    report = verify.verify(path)
    assert report.problems
    if report.metadata:
        verify.repair_metadata(path)
        report = verify.verify(path)
    if report.bad_blocks:
        assert not runner.recompute(open_store(path), report.bad_blocks, lambda progress: None)
    return report


def change_attributes(path, **attributes):
    """Change what a store says about itself; None deletes."""
    record = json.loads((path / "zarr.json").read_text())
    record["attributes"] |= attributes
    record["attributes"] = {k: v for k, v in record["attributes"].items() if v is not None}
    (path / "zarr.json").write_text(json.dumps(record))
