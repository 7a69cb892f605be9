"""Stores that somebody else made: each command tells one line, soon, and touches nothing else."""

import hashlib
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zarr

from sweeps import runner
from sweeps.provenance import provenance
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import ledger
from sweeps.store.opening import dataset, open_store
from tests import faults
from tests.command import call, typed

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
TORTURE = bool(os.environ.get(faults.TORTURE))
FACTS = provenance(32)  # asks git, once


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """A store with one block done and one diverged status in the ledger to be looked up."""
    path = tmp_path_factory.mktemp("honest") / "theirs.zarr"
    made = runner.start(path, parse(PLAN, "f"), 2, 32)
    runner.run(made, lambda _: None, only={0, 1, 2})
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
    """Whoever waits for a FIFO waits for ever."""

    def ring(*_):
        raise AssertionError("it hangs")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def outside(path):
    """Everything beside the store, and when it was written."""
    folder = path.parent.parent
    inside = {path, path.parent / "copy"}
    files = (p for p in folder.rglob("*") if not inside & {*p.parents} and p.is_file())
    return {p: (p.read_bytes(), p.stat().st_mtime_ns, p.stat().st_ino) for p in files}


# --- the changes ---------------------------------------------------------------------------------


def attributes(**changes):
    def change(path):
        record = json.loads((path / "zarr.json").read_bytes())
        for key, value in changes.items():
            if value is None:
                del record["attributes"][key]
            else:
                record["attributes"][key] = value
        (path / "zarr.json").write_text(json.dumps(record))

    return change


def sweep(**changes):
    """Another record, with the right checksum."""

    def change(path):
        record = json.loads((path / "zarr.json").read_bytes())
        text = json.dumps(json.loads(record["attributes"]["sweep"]) | changes)
        digest = hashlib.sha256(text.encode()).hexdigest()
        attributes(sweep=text, sweep_sha256=digest)(path)

    return change


def array(name, **changes):
    """Another array in the metadata."""

    def change(path):
        record = json.loads((path / "zarr.json").read_bytes())
        told = record["consolidated_metadata"]["metadata"][name]
        for key, value in changes.items():
            told[key] = value(told[key]) if callable(value) else value
        (path / "zarr.json").write_text(json.dumps(record))

    return change


def replaced(name, make):
    """Something else in a file's or a folder's place."""

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


def text(content):
    return lambda place, victim: place.write_bytes(content)


def rows(sql, *values):
    """A changed ledger, its seal being right again."""

    def change(path):
        with closing(sqlite3.connect(path / "ledger.sqlite")) as database, database:
            database.execute(sql, values)
        (path / "ledger.sha256").write_bytes(ledger.Ledger(path / "ledger.sqlite").sealed())

    return change


def row(block=0, **changes):
    """A row of a block with its own right checksum."""

    def change(path):
        with closing(sqlite3.connect(path / "ledger.sqlite")) as database:
            body = json.loads(
                database.execute("SELECT body FROM blocks WHERE block = 0").fetchone()[0]
            )
        body = json.dumps(body | changes)
        digest = hashlib.sha256(f"{block}\n{body}".encode()).hexdigest()
        rows("INSERT OR REPLACE INTO blocks VALUES (?, ?, ?)", block, body, digest)(path)

    return change


def names(place, size=1, content=b"x"):
    """A file outside the store in the ledger, with right checksums."""

    def change(path):
        told = content if content is not None else b""
        body = json.dumps({"size": len(told) * size, "sha256": hashlib.sha256(told).hexdigest()})
        digest = hashlib.sha256(f"{place}\n{body}".encode()).hexdigest()
        rows("INSERT INTO fixed VALUES (?, ?, ?, ?)", place, body, content, digest)(path)

    return change


def schema(*statements):
    def change(path):
        (path / "ledger.sqlite").unlink()
        with closing(sqlite3.connect(path / "ledger.sqlite")) as database, database:
            for statement in statements:
                database.execute(statement)

    return change


def journal(path):
    """SQLite removes the file that a journal names at its end, once it has been rolled back."""
    name = str(path.parent.parent / "victim" / "file").encode()
    checksum = sum(name) & 0xFFFFFFFF
    page = (path / "ledger.sqlite").stat().st_size // 4096
    head = bytes.fromhex("d9d505f920a163d7") + b"\0\0\0\0" * 2
    head += page.to_bytes(4, "big") + (512).to_bytes(4, "big") + (4096).to_bytes(4, "big")
    tail = (2**30 // 4096 + 1).to_bytes(4, "big") + name + len(name).to_bytes(4, "big")
    tail += checksum.to_bytes(4, "big") + bytes.fromhex("d9d505f920a163d7")
    (path / "ledger.sqlite-journal").write_bytes(head.ljust(512, b"\0") + tail)


def version_2(path):
    shutil.rmtree(path)
    zarr.create_group(path, zarr_format=2).create_array("nmse", shape=(2,), dtype="f4")


def plain_group(path):
    """All of it but the one file with all metadata."""
    record = json.loads((path / "zarr.json").read_bytes())
    del record["consolidated_metadata"]
    (path / "zarr.json").write_text(json.dumps(record))


def format_1(inner):
    """The format that needs no ledger must not be a way around it."""

    def change(path):
        attributes(format=1)(path)
        inner(path)

    return change


def linked_array(path):
    (path / "nmse").rename(path.parent / "elsewhere")
    (path / "nmse").symlink_to(path.parent / "elsewhere")


def linked_coordinate(path):
    (path / "Td").rename(path.parent / "elsewhere")
    (path / "Td").symlink_to(path.parent / "elsewhere")


def linked_partial(path):
    (path / "more").symlink_to(path.parent.parent / "victim")


def grow(name, size):
    return lambda path: os.truncate(path / name, size)  # takes no room


def chunks(*shape):
    return lambda grid: grid | {"configuration": {"chunk_shape": shape}}


BYTES = {"name": "null_terminated_bytes", "configuration": {"length_bytes": 10**9}}
SLASHES = {"name": "default", "configuration": {"separator": "/"}}
CODEC = {"name": "numcodecs.pickle", "configuration": {}}
HUGE = {"name": "regular", "configuration": {"chunk_shape": [1, 10**12]}}
LONG = "x" * 300

DAMAGED = {  # a store that is refused by every command
    "no attributes": attributes(sweep=None),
    "no checksum": attributes(sweep_sha256=None),
    "no chunk": attributes(block_cells=None),
    "no format": attributes(format=None),
    "format 3": attributes(format=3),
    "format text": attributes(format="2"),
    "format list": attributes(format=[2]),
    "dtype": attributes(dtype="object"),
    "dtype list": attributes(dtype=["float32"]),
    "chunk 0": attributes(block_cells=0),
    "chunk text": attributes(block_cells="many"),
    "chunk list": attributes(block_cells=[1]),
    "chunk huge": attributes(block_cells=10**30),
    "record of another type": attributes(sweep=[1]),
    "record not JSON": attributes(sweep="{"),
    "record deep": attributes(sweep="[" * 100_000),
    "record a list": attributes(sweep="[]"),
    "metric": sweep(metrics=["../../victim/file"]),
    "name": sweep(name="../../victim"),
    "axis": sweep(axes={"../../victim": [1.0, 2.0]}),
    "cells": sweep(axes={n: {"lin": [1, 2], "n": 10**7} for n in ("Td", "K0", "S")}),
    "axis huge": sweep(axes={"Td": {"lin": [1, 2], "n": 10**7}, "K0": [1.0, 2.0]}),
    "shape": array("nmse", shape=[2, 4]),
    "shape huge": array("nmse", shape=[2, 10**12], chunk_grid=HUGE),
    "chunk bomb": array("nmse", chunk_grid=HUGE),
    "chunk other": array("nmse", chunk_grid=chunks(1, 1)),
    "coordinate bomb": array("Td", chunk_grid=chunks(10**12)),
    "codec": array("nmse", codecs=[CODEC]),
    "codec beside": array("nmse", codecs=lambda c: [*c, {"name": "zstd", "configuration": {}}]),
    "codec unknown": array("nmse", codecs=[{"name": "os.system", "configuration": {"x": "true"}}]),
    "objects": array("nmse", data_type="object"),
    "numbers": array("nmse", data_type="float64"),
    "integers": array("status", data_type="int64"),
    "bytes": array("Td", data_type=BYTES),
    "no arrays": plain_group,
    "version 2": version_2,
    "no JSON": replaced("zarr.json", text(b"\0" * 99)),
    "deep JSON": replaced("zarr.json", text(b"[" * 200_000)),
    "large JSON": grow("zarr.json", 2**40),
    "list": replaced("zarr.json", text(b"[]")),
    "no zarr.json": replaced("zarr.json", lambda place, victim: None),
    "FIFO zarr.json": replaced("zarr.json", fifo),
    "device zarr.json": replaced("zarr.json", device),
    "loop zarr.json": replaced("zarr.json", loop),
    "folder zarr.json": replaced("zarr.json", folder),
    "linked array": linked_array,
    "linked coordinate": linked_coordinate,
    "looped array": replaced("nmse", loop),
    "format 1, linked chunk": format_1(replaced("nmse/c.0.0", link)),
    "format 1, FIFO chunk": format_1(replaced("status/c.0.0", fifo)),
    "format 1, other link": format_1(linked_partial),
}  # fmt: skip
TOUCHED = {  # a store of which something can be told, or mended
    "ledger text": replaced("ledger.sqlite", text(b"precious")),
    "ledger empty": replaced("ledger.sqlite", text(b"")),
    "ledger gone": replaced("ledger.sqlite", lambda place, victim: None),
    "ledger link": replaced("ledger.sqlite", link),
    "ledger FIFO": replaced("ledger.sqlite", fifo),
    "ledger device": replaced("ledger.sqlite", device),
    "ledger folder": replaced("ledger.sqlite", folder),
    "journal link": replaced("ledger.sqlite-journal", link),
    "journal FIFO": replaced("ledger.sqlite-journal", fifo),
    "journal of another": journal,
    "write-ahead log": rows("PRAGMA journal_mode = wal"),
    "endless view": schema(
        ledger.SCHEMA[0],
        "CREATE VIEW blocks AS WITH RECURSIVE n(block) AS (SELECT 1 UNION ALL SELECT block + 1 "
        "FROM n) SELECT block, '{}' AS body, '' AS sha256 FROM n",
    ),
    "trigger": rows(
        "CREATE TRIGGER t AFTER INSERT ON blocks BEGIN DELETE FROM blocks; END"
    ),
    "other table": rows("CREATE TABLE more (x)"),
    "no tables": schema("CREATE TABLE x (y)"),
    "large value": rows("UPDATE blocks SET body = zeroblob(9000000)"),
    "block text": rows("INSERT INTO fixed VALUES (1, 2, 3, 4)"),
    "block far": row(block=10**15),
    "block negative": row(block=-1),
    "row of words": row(ok="many", files=[]),
    "row deep": rows("UPDATE blocks SET body = ?", "[" * 100_000),
    "row of a metric": row(files={"../../victim/file": {"size": 1, "sha256": "x"}}),
    "row of nothing": row(files={}),
    "row of a size": row(files={"nmse": {"size": 10**18, "sha256": "x"}}),
    "row of a type": row(files={"nmse": {"size": "x", "sha256": 3}, "status": 7}),
    "row escaping": row(outcome="set aside", error="\x1b[2J\n" + "x" * 10_000),
    "names a file outside": names("../../victim/file"),
    "names it rightly": names("../../victim/file", content=b"precious " * 9),
    "names another": names("/etc/passwd"),
    "names a root": names("zarr.json/../../../victim/file"),
    "names a device": names("../../../../../../dev/zero"),
    "names a file in": names("Td/c.7"),
    "seal link": replaced("ledger.sha256", link),
    "seal FIFO": replaced("ledger.sha256", fifo),
    "seal large": grow("ledger.sha256", 2**40),
    "seal folder": replaced("ledger.sha256", folder),
    "lock link": replaced("owner.lock", link),
    "lock FIFO": replaced("owner.lock", fifo),
    "lock text": replaced("owner.lock", text(b'{"block": "x", "pid": [')),
    "lock number": replaced("owner.lock", text(b"1e999")),
    "lock deep": replaced("owner.lock", text(b"[" * 1000)),
    "lock folder": replaced("owner.lock", folder),
    "chunk link": replaced("nmse/c.0.0", link),
    "chunk FIFO": replaced("nmse/c.0.0", fifo),
    "status FIFO": replaced("status/c.0.0", fifo),
    "chunk device": replaced("status/c.0.0", device),
    "chunk folder": replaced("nmse/c.0.0", folder),
    "chunk large": grow("nmse/c.0.0", 2**40),
    "chunk FIFO to come": replaced("nmse/c.1.1", fifo),
    "chunk link to come": replaced("nmse/c.1.1", link),
    "partial link": replaced("nmse/c.1.1.partial", link),
    "partial FIFO": replaced("nmse/c.1.1.partial", fifo),
    "partial folder": replaced("nmse/c.1.1.partial", folder),
    "other link": linked_partial,
    "coordinate link": replaced("Td/c.0", link),
    "coordinate FIFO": replaced("Td/c.0", fifo),
    "metadata link": replaced("Td/zarr.json", link),
    "long name": replaced(LONG[:250], text(b"")),
    "told": attributes(revision="\x1b[2J" + "x" * 10**6, device=["a"], start={"a": 1}),
    "told nothing": attributes(revision=None, start=None, device=None),
    "fill value": array("nmse", fill_value=1.0),
    "names of files": array("nmse", chunk_key_encoding=SLASHES),
}  # fmt: skip
COMMANDS = {
    "status": (0, 2),
    "export": (0, 2),
    "verify": (1, 2),
    "extend": (0, 1, 2),
    "repair": (0, 1, 2),
}
if TORTURE:  # each goes in by the door of another
    COMMANDS |= {"plot": (0, 2), "resume": (0, 1, 2)}
SAME = {"row escaping", "lock text", "lock number", "lock deep", "journal of another"}  # to verify


def commands(path):
    folder = path.parent
    return {
        "status": ("status", path),
        "plot": ("plot", path, "--x", "Td", "--y", "contact", "--out", folder / "a.png"),
        "export": ("export", path, "--to", "csv", "--out", folder / "a.csv"),
        "verify": ("verify", path),
        "extend": ("resume", path, "--extend", folder.parent / "larger.toml"),
        "resume": ("resume", path),
        "repair": ("verify", path, "--repair"),
    }


def check(path, command, codes):
    """One line where it is refused, none of another kind, and nothing beside it touched."""
    before, began = outside(path), time.process_time()
    told = typed(*commands(path)[command])
    assert told.code in codes, (command, told)
    if told.code == 2:
        assert len(told.stderr.splitlines()) == 1, told.stderr
        assert told.stderr.startswith("fic-sweep: ")
    assert all(line.isprintable() for line in (told.stderr + told.stdout).splitlines())
    assert len(told.stderr + told.stdout) < 20_000
    assert time.process_time() - began < 5
    after = outside(path)
    assert {p: after.get(p) for p in before} == before
    for made in (path.parent / "a.png", path.parent / "a.csv"):
        made.unlink(missing_ok=True)
    return told


@pytest.mark.parametrize("change", DAMAGED)
def test_what_is_none_of_ours_is_refused_by_every_command(theirs, change):
    DAMAGED[change](theirs)
    for command, codes in COMMANDS.items():
        if command == "verify" and not TORTURE:
            continue  # what --repair does first
        # our metadata may be in the ledger still
        check(theirs, command, codes if command in ("verify", "repair") else (2,))


@pytest.mark.parametrize("change", TOUCHED)
def test_what_is_changed_is_told_or_mended_and_nothing_else_touched(theirs, change):
    TOUCHED[change](theirs)
    copy = theirs.parent / "copy"
    shutil.copytree(theirs, copy, symlinks=True, copy_function=_copy)
    for command, codes in COMMANDS.items():
        if command in ("extend", "resume", "repair"):
            shutil.rmtree(theirs)
            shutil.copytree(copy, theirs, symlinks=True, copy_function=_copy)
        check(theirs, command, (0, *codes) if change in SAME else codes)


def _copy(source, target):
    """Files as they are, holes and FIFOs too."""
    if Path(source).is_fifo():
        os.mkfifo(target)
    elif Path(source).stat(follow_symlinks=False).st_size > 2**30:
        Path(target).touch()
        os.truncate(target, Path(source).stat().st_size)
    else:
        shutil.copy2(source, target, follow_symlinks=False)


def test_the_store_itself_passes(theirs):
    """Unchanged, every command does what it is for."""
    for command in ("status", "plot", "export"):
        check(theirs, command, (0,))
    check(theirs, "verify", (0,))
    for command in ("resume", "extend", "repair"):
        check(theirs, command, (0,))
    assert dataset(theirs).sizes["Td"] == 4
    assert np.all(dataset(theirs)["status"] == 1)


def test_a_name_too_long(tmp_path):
    for command in COMMANDS:
        path = tmp_path / "in" / LONG
        path.parent.mkdir(exist_ok=True)
        (tmp_path / "larger.toml").write_text(LARGER)
        check(path, command, (2,))


def test_a_store_is_not_begun_where_one_waits_for_its_extension(theirs):
    """`resume` would take it for the larger one, and remove the other."""
    theirs.rename(theirs.with_name(f".{theirs.name}.before"))
    with pytest.raises(SweepError, match="finishes its extension, which was cut short"):
        runner.start(theirs, parse(PLAN, "f"), 2, 32)
    assert typed("resume", theirs).code == 0
    assert open_store(theirs).rows()


@pytest.mark.parametrize("change", ["status FIFO", "journal FIFO"])
def test_the_command_itself_tells_one_line(theirs, change):
    TOUCHED[change](theirs)
    before = outside(theirs)
    told = call("export", str(theirs), "--to", "csv", code=2, folder=theirs.parent)
    assert len(told.stderr.splitlines()) == 1
    assert outside(theirs) == before


def test_a_bomb_takes_no_memory(theirs):
    """In a process of 400 MB more than it has."""
    DAMAGED["chunk bomb"](theirs)
    code = (
        "import resource, sys\n"
        "from sweeps.store import opening as store\nimport xarray\nfrom pathlib import Path\n"
        "have = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (have + 4 * 10**8,) * 2)\n"
        "try:\n    store.dataset(Path(sys.argv[1]))\n"
        "except store.SweepError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, theirs], capture_output=True, text=True, check=True
    )
    assert "its variable nmse is not the one of its sweep" in done.stdout
