"""Stores that somebody else made or changed: refused, read or repaired in one line; no other file
is read as theirs or touched."""

import hashlib
import json
import os
import shutil
import signal
import sqlite3
from contextlib import closing

import pytest
import xarray as xr
import zarr

from sweeps import runner
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import ledger
from sweeps.store.opening import dataset, open_store
from tests.command import typed
from tests.store.stores import change_attributes

PLAN = """
name = "theirs"
metrics = ["nmse"]
[time]
t_end = 0.1
[model]
contact = ["welded", "hard_stop"]
[axes]
Td = [1.0, 5.0, 20.0]
"""
LARGER = PLAN.replace("5.0, 20.0", "5.0, 20.0, 30.0")
FACTS = runner.provenance(32)  # runs git once


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """A store of four blocks, three of them done."""
    path = tmp_path_factory.mktemp("honest") / "theirs.zarr"
    runner.run(runner.start(path, parse(PLAN, "f"), 2, 32), lambda _: None, only={0, 1, 2})
    return path


@pytest.fixture
def theirs(honest, tmp_path, monkeypatch):
    """A copy to be changed, and files outside that no command may touch."""
    monkeypatch.setattr(runner, "provenance", lambda *_: FACTS)
    shutil.copytree(honest, tmp_path / "in" / "theirs.zarr")
    (tmp_path / "victim").mkdir()
    for name in ("file", "c.0.0", "c.9.partial", "zarr.json", "ledger.sqlite"):
        (tmp_path / "victim" / name).write_bytes(b"precious " * 9)
    (tmp_path / "larger.toml").write_text(LARGER)
    return tmp_path / "in" / "theirs.zarr"


@pytest.fixture(autouse=True)
def alarm():
    """A read of a FIFO never ends; nothing else here takes ten minutes, on any machine."""

    def ring(*_):
        raise AssertionError("it waits for a FIFO")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(600)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def outside(path):
    """Every file beside the store, and when it was written."""
    folder = path.parent.parent
    files = (p for p in folder.rglob("*") if path not in p.parents and p.is_file())
    return {p: (p.read_bytes(), p.stat().st_mtime_ns, p.stat().st_ino) for p in files}


def told(path, command, codes):
    """A command refuses in one line, and touches nothing outside."""
    before = outside(path)
    options = {
        "export": ("--to", "csv", "--out", path.parent / "a.csv"),
        "resume": ("--extend", path.parent.parent / "larger.toml"),
        "repair": ("--repair",),
    }
    done = typed({"repair": "verify"}.get(command, command), path, *options.get(command, ()))
    assert done.code in codes, (command, done)
    if done.code == 2:
        assert len(done.stderr.splitlines()) == 1, done.stderr
        assert done.stderr.startswith("fic-sweep: ")
    assert all(line.isprintable() for line in (done.stderr + done.stdout).splitlines())
    assert len(done.stderr + done.stdout) < 20_000
    after = outside(path)
    assert {p: after.get(p) for p in before} == before
    (path.parent / "a.csv").unlink(missing_ok=True)
    return done


# --- the changes ---------------------------------------------------------------------------------


def attributes(**changes):
    return lambda path: change_attributes(path, **changes)


def sweep(**changes):
    """Another record, with the right hash."""

    def change(path):
        record = json.loads((path / "zarr.json").read_bytes())["attributes"]["sweep"]
        text = json.dumps(json.loads(record) | changes)
        change_attributes(path, sweep=text, sweep_sha256=hashlib.sha256(text.encode()).hexdigest())

    return change


def array(name, **changes):
    """Another array in the metadata."""

    def change(path):
        record = json.loads((path / "zarr.json").read_bytes())
        record["consolidated_metadata"]["metadata"][name] |= changes
        (path / "zarr.json").write_text(json.dumps(record))

    return change


def replaced(name, make):
    """Something else in the place of a file or a folder."""

    def change(path):
        place = path / name
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)
        make(place, path.parent.parent / "victim")

    return change


def link(place, victim):
    place.symlink_to(victim if place.suffix == "" and "c." not in place.name else victim / "file")


def loop(place, victim):
    place.symlink_to(place)


def fifo(place, victim):
    os.mkfifo(place)


def device(place, victim):
    place.symlink_to("/dev/zero")


def folder(place, victim):
    place.mkdir()
    (place / "x").write_text("")


def gone(place, victim):
    pass


def text(content):
    return lambda place, victim: place.write_bytes(content)


def grow(name, size):
    return lambda path: os.truncate(path / name, size)  # takes no room


def rows(sql, *values):
    """A changed ledger, with its right checksum."""

    def change(path):
        with closing(sqlite3.connect(path / "ledger.sqlite")) as database, database:
            database.execute(sql, values)
        checksum = ledger.Ledger(path / "ledger.sqlite").checksum()
        (path / "ledger.sha256").write_bytes(checksum)

    return change


def row(block=0, **changes):
    """A row of a block, with its right checksum."""

    def change(path):
        with closing(sqlite3.connect(path / "ledger.sqlite")) as database:
            query = "SELECT body FROM blocks WHERE block = 0"
            body = json.loads(database.execute(query).fetchone()[0])
        body = json.dumps(body | changes)
        digest = hashlib.sha256(f"{block}\n{body}".encode()).hexdigest()
        rows("INSERT OR REPLACE INTO blocks VALUES (?, ?, ?)", block, body, digest)(path)

    return change


def names(place, content):
    """A file in the ledger, with right checksums."""

    def change(path):
        digest = hashlib.sha256(content).hexdigest()
        body = json.dumps({"size": len(content), "sha256": digest})
        digest = hashlib.sha256(f"{place}\n{body}".encode()).hexdigest()
        rows("INSERT INTO fixed VALUES (?, ?, ?, ?)", place, body, content, digest)(path)

    return change


def axis_outside(path):
    """An array that is the folder around the store."""
    sweep(axes={"..": [1.0, 5.0, 20.0]})(path)
    record = json.loads((path / "zarr.json").read_bytes())
    known = record["consolidated_metadata"]["metadata"]
    known[".."] = known.pop("Td")
    (path / "zarr.json").write_text(json.dumps(record))


def version_2(path):
    shutil.rmtree(path)
    zarr.create_group(path, zarr_format=2).create_array("nmse", shape=(2,), dtype="f4")


def of_xarray(path):
    shutil.rmtree(path)
    xr.Dataset({"a": ("x", [1.0])}).to_zarr(path, consolidated=False)


def plain_group(path):
    """Without the metadata of the arrays."""
    record = json.loads((path / "zarr.json").read_bytes())
    del record["consolidated_metadata"]
    (path / "zarr.json").write_text(json.dumps(record))


def moved(name):
    """A link to its own contents, elsewhere."""

    def change(path):
        (path / name).rename(path.parent / "elsewhere")
        (path / name).symlink_to(path.parent / "elsewhere")

    return change


def format_1(inner):
    """The format without a ledger must be no way around the checks."""

    def change(path):
        change_attributes(path, format=1, metrics_definition=None)
        inner(path)

    return change


def chunks(*shape):
    return {"name": "regular", "configuration": {"chunk_shape": shape}}


ZSTD = {"name": "zstd", "configuration": {"level": 0, "checksum": False}}
IS_NOT = "is not the one of its sweep"
NO_STORE = "is no result store"
LINK = "has a link in it"
REFUSED = {  # by every command, with these words
    "a file": (lambda path: (shutil.rmtree(path), path.write_text("hello")), NO_STORE),
    "of xarray": (of_xarray, NO_STORE),
    "version 2": (version_2, NO_STORE),
    "no attributes": (attributes(sweep=None), NO_STORE),
    "no hash": (attributes(sweep_sha256=None), NO_STORE),
    "format 4": (attributes(format=4), "has format 4; this program reads up to 3"),
    "format text": (attributes(format="2"), "has format 2; this program"),
    "format list": (attributes(format=[2]), r"has format \[2\]; this program"),
    "other definition": (attributes(metrics_definition="x"), NO_STORE),
    "definition list": (attributes(metrics_definition=["motion"]), NO_STORE),
    "no definition": (attributes(metrics_definition=None), NO_STORE),
    "old format, new metrics": (attributes(format=2), NO_STORE),
    "dtype": (attributes(dtype="object"), NO_STORE),
    "block of 0": (attributes(block_cells=0), NO_STORE),
    "block of words": (attributes(block_cells="many"), NO_STORE),
    "record a list": (attributes(sweep=[1]), NO_STORE),
    "record changed": (attributes(sweep="{}"), "sweep record differs"),
    "metric": (sweep(metrics=["../../victim/file"]), NO_STORE),
    "name": (sweep(name="../../victim"), NO_STORE),
    "axis": (sweep(axes={"../../victim": [1.0, 2.0]}), IS_NOT),
    "axis outside": (axis_outside, IS_NOT),
    "cells": (sweep(axes={n: {"lin": [1, 2], "n": 10**7} for n in ("Td", "K0")}), "must be"),
    "shape": (array("nmse", shape=[2, 4]), IS_NOT),
    "large shape": (array("nmse", shape=[2, 10**12], chunk_grid=chunks(1, 10**12)), IS_NOT),
    "large chunk": (array("nmse", chunk_grid=chunks(1, 10**12)), IS_NOT),
    "large chunk of a coordinate": (array("Td", chunk_grid=chunks(10**12)), IS_NOT),
    "codec": (array("nmse", codecs=[{"name": "bytes"}, ZSTD]), IS_NOT),
    "data type": (array("nmse", data_type="float64"), IS_NOT),
    "no arrays": (plain_group, "its metadata is not in one file"),
    "no JSON": (replaced("zarr.json", text(b"\0" * 99)), NO_STORE),
    "large JSON": (grow("zarr.json", 2**40), "its zarr.json is too large"),
    "no zarr.json": (replaced("zarr.json", gone), NO_STORE),
    "FIFO zarr.json": (replaced("zarr.json", fifo), NO_STORE),
    "device zarr.json": (replaced("zarr.json", device), NO_STORE),
    "loop zarr.json": (replaced("zarr.json", loop), "can't be read: Too many levels"),
    "folder zarr.json": (replaced("zarr.json", folder), NO_STORE),
    "linked array": (moved("nmse"), IS_NOT),
    "linked coordinate": (moved("Td"), IS_NOT),
    "looped array": (replaced("nmse", loop), IS_NOT),
    "format 1, linked chunk": (format_1(replaced("nmse/c.0.0", link)), LINK),
    "format 1, FIFO chunk": (format_1(replaced("status/c.0.0", fifo)), LINK),
    "format 1, other link": (format_1(replaced("more", link)), LINK),
}

TOUCHED = {  # read, refused or repaired
    "ledger text": replaced("ledger.sqlite", text(b"precious")),
    "ledger empty": replaced("ledger.sqlite", text(b"")),
    "ledger gone": replaced("ledger.sqlite", gone),
    "ledger link": replaced("ledger.sqlite", link),
    "ledger FIFO": replaced("ledger.sqlite", fifo),
    "ledger device": replaced("ledger.sqlite", device),
    "ledger folder": replaced("ledger.sqlite", folder),
    "journal link": replaced("ledger.sqlite-journal", link),
    "journal FIFO": replaced("ledger.sqlite-journal", fifo),
    "block far": row(block=10**15),
    "block negative": row(block=-1),
    "row of words": row(ok="many", files=[]),
    "row of a metric": row(files={"../../victim/file": {"size": 1, "sha256": "x"}}),
    "row of nothing": row(files={}),
    "row of a size": row(files={"nmse": {"size": 10**18, "sha256": "x"}}),
    "names a file outside": names("../../victim/file", b"x"),
    "names it rightly": names("../../victim/file", b"precious " * 9),
    "names a file in": names("Td/c.7", b"x"),
    "checksum link": replaced("ledger.sha256", link),
    "checksum FIFO": replaced("ledger.sha256", fifo),
    "checksum large": grow("ledger.sha256", 2**40),
    "checksum folder": replaced("ledger.sha256", folder),
    "lock link": replaced("owner.lock", link),
    "lock FIFO": replaced("owner.lock", fifo),
    "lock folder": replaced("owner.lock", folder),
    "chunk link": replaced("nmse/c.0.0", link),
    "chunk FIFO": replaced("nmse/c.0.0", fifo),
    "status FIFO": replaced("status/c.0.0", fifo),
    "chunk device": replaced("status/c.0.0", device),
    "chunk folder": replaced("nmse/c.0.0", folder),
    "chunk large": grow("nmse/c.0.0", 2**40),
    "chunk gone": replaced("nmse/c.0.0", gone),
    "array gone": replaced("nmse", gone),
    "next chunk FIFO": replaced("nmse/c.1.1", fifo),
    "next chunk link": replaced("nmse/c.1.1", link),
    "partial link": replaced("nmse/c.1.1.partial", link),
    "partial FIFO": replaced("nmse/c.1.1.partial", fifo),
    "partial folder": replaced("nmse/c.1.1.partial", folder),
    "coordinate link": replaced("Td/c.0", link),
    "coordinate FIFO": replaced("Td/c.0", fifo),
    "metadata link": replaced("Td/zarr.json", link),
    "terminal codes": attributes(revision="\x1b[2J" + "x" * 10**6, device=["a"], start={"a": 1}),
    "no start": attributes(revision=None, start=None, device=None),
}
HARMLESS = {  # `verify` finds nothing, and every command does its work
    "unchanged": lambda path: None,
    "lock text": replaced("owner.lock", text(b'{"block": "x", "pid": [')),
    "lock number": replaced("owner.lock", text(b"1e999")),
    "row escaping": row(outcome="set aside", error="\x1b[2J\n" + "x" * 10_000),
    "other link": replaced("more", link),
    "long name": replaced("x" * 250, text(b"")),
    "file under way": replaced("nmse/c.1.1.partial", text(b"half")),
}


@pytest.mark.parametrize("change", REFUSED)
def test_a_foreign_store_is_refused(theirs, change):
    make, words = REFUSED[change]
    make(theirs)
    for opened in (open_store, dataset):
        with pytest.raises(SweepError, match=words) as refused:
            opened(theirs)
        assert "\n" not in str(refused.value)
    told(theirs, "status", (2,))
    told(theirs, "repair", (0, 1, 2))  # the ledger may have our metadata


CODES = {"status": (0, 2), "export": (0, 2), "verify": (1, 2), "resume": (0, 1, 2)}
CODES |= {"repair": (0, 1, 2)}


@pytest.mark.parametrize("commands", [("status", "export", "verify", "resume"), ("repair",)])
@pytest.mark.parametrize("change", TOUCHED)
def test_a_changed_store_is_refused_or_repaired(theirs, change, commands):
    TOUCHED[change](theirs)
    for command in commands:
        told(theirs, command, CODES[command])


@pytest.mark.parametrize("change", HARMLESS)
def test_a_harmless_change_stops_no_command(theirs, change):
    HARMLESS[change](theirs)
    for command in ("status", "export", "verify", "repair", "resume"):
        told(theirs, command, (0,))
    assert dataset(theirs).sizes["Td"] == 4
    assert (dataset(theirs)["status"] == 1).all()


def test_a_name_that_is_too_long_is_refused(tmp_path):
    path = tmp_path / "in" / ("x" * 300)
    path.parent.mkdir()
    (tmp_path / "larger.toml").write_text(LARGER)
    for command in ("status", "export", "verify", "repair", "resume"):
        told(path, command, (2,))


def test_missing_files_are_refused(golden):
    """Zarr would read fill values."""
    store = open_store(golden)
    store.file("status", 0).unlink()
    with pytest.raises(SweepError, match=r"lacks status/c\.0\.0\.0, of finished blocks"):
        dataset(golden)
    shutil.rmtree(golden / "nmse")
    with pytest.raises(SweepError, match=r"lacks nmse/c\..* and 3 more files, of finished"):
        store.check_files()


def test_a_block_that_is_half_on_the_disk_is_refused(golden):
    """A power cut kept its last file and lost another."""
    store = open_store(golden)
    shutil.copy(store.file("status", 0), store.file("status", 3))
    with pytest.raises(SweepError, match=r"half written; `fic-sweep resume .* writes them"):
        dataset(golden)
