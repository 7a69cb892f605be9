"""Nothing acknowledged is lost or wrong: kills, failing calls, power cuts, damaged files.

`make torture` runs all of it at length; CI takes a part (`many`).
"""

import asyncio
import atexit
import errno
import json
import math
import multiprocessing
import os
import random
import re
import shutil
import signal
import socket
import sqlite3
import sys
import tempfile
import time
import warnings
from collections import Counter
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from fic_jax import Metrics
from sweeps import cli, runner
from sweeps.plan.grid import Grid, cells_of
from sweeps.provenance import KEPT
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import extend, verify
from sweeps.store import format as layout
from sweeps.store.commit import Writer
from sweeps.store.fsync import PARTIAL
from sweeps.store.ledger import DONE, NAME, PARTLY, SEAL, SET_ASIDE, Ledger, Stamp, _opened
from sweeps.store.lock import NAME as LOCK
from sweeps.store.opening import Tally, open_store
from tests.faults import TORTURE, Calls, Disk, Killed, build
from tests.victim import BLOCKS, CELLS, keep, own, work

# Five scenarios in blocks of two; the small sweep is the beginning of the whole one.
TEXT = """
name = "tiny"
metrics = ["nmse", "peak_torque"]
[axes]
K0 = [1.0, 2.0, 3.0, 4.0, 5.0]
"""
WHOLE, SMALL = parse(TEXT, "whole"), parse(TEXT.replace(", 4.0, 5.0", ""), "small")
MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # no flush takes time there


def many(ci, torture):
    return torture if os.environ.get(TORTURE) else ci


def tell(counted):
    """What was counted, for `make torture`, which shows it."""
    sys.stdout.write(f"\n{counted}")


def cheap(grid, block, dtype, cells=slice(None)):
    """Instead of the engine: the same bits from the same scenario, and one that diverges."""
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


@pytest.fixture(scope="module")
def memory():
    with tempfile.TemporaryDirectory(dir=MEMORY, prefix="fic-sweep-") as folder:
        yield Path(folder)


@pytest.fixture
def quick(monkeypatch):
    """Thousands of runs, with the same calls every time: no engine, no block encoded twice, no
    threads of ours or of Zarr's."""
    monkeypatch.setattr(runner, "_compute", cheap)
    monkeypatch.setattr(runner, "ThreadPoolExecutor", Inline)
    monkeypatch.setattr(Writer, "_encode", encoded)
    monkeypatch.setattr(asyncio, "to_thread", at_once)


async def at_once(function, *args, **kwargs):
    return function(*args, **kwargs)


ENCODE, ENCODED = Writer._encode, {}


def encoded(writer, index, name, values):
    key = (writer.store.grid.shape, index, name, values.tobytes())
    if key not in ENCODED:
        ENCODED[key] = ENCODE(writer, index, name, values)
    return ENCODED[key]


class Stores:
    """A folder of stores to begin a case with, and what each size must come to, file by file.

    `whole` and `small` are finished; of `begun`, of the whole sweep, a block is done, one in part
    and one is set aside; of `damaged` the record, a coordinate and the ledger are not as written,
    of `bad` a block.
    """

    def __init__(self, folder):
        self.folder = folder
        run(runner.start(folder / "whole", WHOLE, 2, 32))
        run(runner.start(folder / "small", SMALL, 2, 32))
        self.attributes = open_store(folder / "whole").group.attrs.asdict()
        self.expected = {n: contents(folder / name) for n, name in ((5, "whole"), (3, "small"))}
        self._begin()
        self._damage()
        shutil.copytree(folder / "whole", folder / "bad")
        flip(folder / "bad/nmse/c.1", 99)

    def _begin(self):
        shutil.copytree(self.folder / "small", self.folder / "begun")
        extend.extend(open_store(self.folder / "begun"), WHOLE, "whole")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(runner, "_compute", lambda *_: 1 / 0)
            runner.run(open_store(self.folder / "begun"), lambda p: None, only=[2])
        outcomes = [row.outcome for row in open_store(self.folder / "begun").rows()]
        assert outcomes == [DONE, PARTLY, SET_ASIDE]

    def _damage(self):
        folder = self.folder / "damaged"
        shutil.copytree(self.folder / "whole", folder)
        flip(folder / "zarr.json", 999)
        (folder / "K0/c.0").unlink()
        with sqlite3.connect(folder / NAME) as ledger:
            ledger.execute("UPDATE blocks SET body = 'x' WHERE block = 1")
        ledger.close()


@pytest.fixture(scope="module")
def stores(memory):
    folder = memory / "stores"
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_compute", cheap)
        return Stores(folder)


def flip(file, bit):
    """Turn one bit of a file round."""
    content = bytearray(file.read_bytes())
    content[bit // 8 % len(content)] ^= 1 << bit % 8
    file.write_bytes(content)


class Told:
    """The acknowledgements of a run: cells that it said are on the disk."""

    cells = 0

    def __call__(self, progress):
        self.cells = progress.done


def run(store, tell=lambda p: None):
    return runner.run(store, tell)


def contents(path):
    """Every file of a store that must come out the same; of its record all but its times."""
    files = {
        str(file.relative_to(path)): file.read_bytes()
        for file in path.rglob("*")
        if file.is_file() and not file.name.startswith(("ledger.", "owner."))
    }
    record = json.loads(files["zarr.json"])
    for key in ("start", "end", "extended"):
        record["attributes"].pop(key, None)
    return files | {"zarr.json": record}


def sound(path, stores, cells=0, taken_out=()):
    """Every row of a ledger is true, `cells` are done at least, and `verify` finds nothing."""
    true_to(path, stores.expected[open_store(path).grid.cells], cells)
    problems = verify.verify(path).problems
    assert {problem.block for problem in problems} <= set(taken_out), problems


def true_to(path, expected, cells):
    """Every row of a ledger is true, and `cells` are done at least."""
    store = open_store(path)
    rows = store.rows()
    for row in rows:
        for name, stamp in row.files.items():
            file = store.file(name, row.block)
            content = file.read_bytes()
            assert Stamp.of(content) == stamp, file
            if row.outcome == DONE:
                assert content == expected[str(file.relative_to(path))], file
    done = [cells_of(store.grid.block(row.block)) for row in rows if row.outcome == DONE]
    assert sum(done) >= cells


def settle(path, stores, damaged=False):
    """What its owner does after a mishap; it ends with the files of an undisturbed run."""
    extend.recover(path)
    if not path.exists():
        create(path, stores)
    if damaged:
        verify.mend_frame(path)
    if open_store(path).grid.cells == 3:
        enlarge(path)
    run(open_store(path))
    assert contents(path) == stores.expected[5]
    assert not verify.verify(path).problems
    assert not Tally.of(open_store(path)).pending
    assert os.listdir(path.parent) == [path.name]


@contextmanager
def case(memory, source):
    """A fresh copy of a store, or no store; removed afterwards."""
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        path = Path(folder) / "tiny.zarr"
        if source:
            shutil.copytree(source, path)
        yield path


def create(path, stores, told=None):
    attributes = {key: stores.attributes[key] for key in (*KEPT, "start")}
    layout.create(path, Grid(WHOLE, 2), attributes)


def enlarge(path, stores=None, told=None):
    extend.extend(open_store(path), WHOLE, "whole")


def mend(path, stores=None, told=None):
    verify.mend_frame(path)


AGAIN = [0, 2]


def again(path, stores, told):
    verify.recompute(open_store(path), AGAIN, told)


def go_on(path, stores, told):
    run(open_store(path), told)


# what is done, to which store, every how many-th of its calls fails in CI
DEEDS = [
    (go_on, "begun", 1),
    (again, "whole", 6),
    (create, None, 8),
    (enlarge, "small", 10),
    (mend, "damaged", 4),
]
deeds = pytest.mark.parametrize(
    ("deed", "source", "every"), DEEDS, ids=lambda d: getattr(d, "__name__", "")
)


def spoilt(memory, stores, deed, source, every, fault, names=None):
    """Do it undisturbed, then as often as it has calls, with a fault at one more each time."""
    calls, numbers = [], [-1]
    while numbers:
        number = numbers.pop()
        with case(memory, source and stores.folder / source) as path:
            told, failed = Told(), None
            with Calls(path.parent, fault(number)) as disk:
                try:
                    deed(path, stores, told)
                except (Killed, OSError, SweepError) as error:
                    failed = error
            if number < 0:
                calls = disk.made
                numbers = [call.number for call in calls if not names or call.name in names]
                numbers = numbers[:: many(every, 1)]
            yield path, calls[number] if number >= 0 else None, failed, told


def killed_at(number):
    return lambda call: Killed if call.number == number else None


@deeds
def test_a_kill_at_any_call_loses_nothing(memory, stores, quick, deed, source, every):
    n = 0
    for path, call, failed, told in spoilt(memory, stores, deed, source, every, killed_at):
        assert isinstance(failed, Killed) == (call is not None)
        if path.exists() and source != "damaged":
            sound(path, stores, told.cells, AGAIN if deed is again else ())
        if not n % many(3, 1):
            settle(path, stores, source == "damaged")
        n += 1
    tell(f"{deed.__name__}: killed at {n - 1} of its calls")


def broken_at(number):
    """One call fails, as on a bad sector; the next one works."""
    return lambda call: errno.EIO if call.number == number else None


FILLING = {"write", "pwrite", "create", "mkdir", "commit", "fsync"}  # what needs room


def full_from(number):
    """The disk is full from a call on."""
    return lambda call: (
        errno.ENOSPC if call.number >= number >= 0 and call.name in FILLING else None
    )


def may_fail(call, store):
    """Whether a deed goes on without a call: hints, seals, what is tidied away."""
    aside = ("/owner.lock", "/ledger.sha256", ".zarr.before", "/ledger.sqlite")
    about = any(name in call.path for name in aside) and call.name != "commit"
    return about or call.name == "mkdir" or Path(call.path).name == store.name


@pytest.mark.parametrize("fault", [broken_at, full_from])
@deeds
def test_an_error_of_the_system_at_any_call_is_survived(
    memory, stores, quick, deed, source, every, fault
):
    n = ended = 0
    for path, call, failed, told in spoilt(memory, stores, deed, source, 2 * every, fault):
        n, ended = n + 1, ended + bool(failed)
        if call and call.name not in ("unlink", "rmdir"):
            assert not list(path.parent.rglob(f"*{PARTIAL}")), call
            assert failed or fault is full_from or may_fail(call, path), call
        if path.exists() and source != "damaged":
            sound(path, stores, told.cells, AGAIN if deed is again else ())
        if not n % many(3, 1):
            settle(path, stores, source == "damaged")
    tell(f"{deed.__name__}: {n - 1} times {fault.__name__} a call, which ended it {ended} times")
    assert ended > n / 2


def short_at(number):
    """A write takes a third of what it is given."""
    return lambda call: 0.3 if call.number == number else None


def all_short_from(number):
    """Every write from one on takes some bytes only."""
    return lambda call: 0.01 if call.number >= number >= 0 else None


@pytest.mark.parametrize("fault", [short_at, all_short_from])
def test_a_short_write_is_gone_on_with(memory, stores, quick, fault):
    n = 0
    for path, _, failed, told in spoilt(memory, stores, go_on, "begun", 1, fault, ["write"]):
        assert (failed, told.cells) == (None, 5)
        assert contents(path) == stores.expected[5]
        n += 1
    tell(f"{n - 1} short writes")
    assert n > 7


def begin(path, stores, told):
    create(path, stores)
    run(open_store(path), told)


# what is done, to which store, where, and every how many-th cut disk is gone on with in CI
CUTS = [
    (begin, None, "new/folder/tiny.zarr", 16),
    (go_on, "begun", "tiny.zarr", 4),
    (again, "whole", "tiny.zarr", 8),
    (enlarge, "small", "tiny.zarr", 16),
    (mend, "damaged", "tiny.zarr", 4),
]


@pytest.mark.parametrize(("deed", "source", "place", "every"), CUTS)
def test_a_power_cut_after_any_call_loses_nothing(
    memory, stores, quick, deed, source, place, every
):
    """The worst case, where all that was not flushed is lost, and cases in between by a coin."""
    coin, told, cuts = random.Random(1), Told(), 0
    disks = {}  # each once, with the most that was acknowledged
    with case(memory, source and stores.folder / source) as path:
        folder = path.parent
        disk = Disk(folder)

        def after(call):
            nonlocal cuts
            disk.after(call)
            for share in (0, *many([0.5], [0.2, 0.5, 0.5, 0.8, 1])):
                left = disk.left(lambda share=share: coin.random() < share)
                disks[frozenset(left.items())] = (left, told.cells, call)
                cuts += 1

        with Calls(folder, after=after):
            deed(folder / place, stores, told)
    for i, (left, cells, call) in enumerate(disks.values()):
        with case(memory, None) as path:
            build(left, path.parent / "left")
            store = path.parent / "left" / place
            extend.recover(store)
            if cells or (source and deed is not mend):
                assert store.exists(), call
            if store.exists() and source != "damaged":
                sound(store, stores, cells, AGAIN if deed is again else ())
            if not i % many(every, 1):
                settle(store, stores, source == "damaged")
    tell(f"{deed.__name__}: {cuts} power cuts, {len(disks)} different disks")


def flipped(file, chance):
    flip(file, chance.randrange(8 * file.stat().st_size))


def cut_off(file, chance):
    file.write_bytes(file.read_bytes()[: chance.randrange(file.stat().st_size)])


def deleted(file, _):
    file.unlink()


def folder_instead(file, _):
    file.unlink()
    file.mkdir()
    (file / "c.0").write_bytes(b"something")


def linked(file, _):
    """To its own contents, elsewhere."""
    file.rename(file.parent.parent.parent / "elsewhere")
    file.symlink_to(file.parent.parent.parent / "elsewhere")


def swapped(file, chance):
    """With another file of the same folder, if there is one."""
    others = [p for p in file.parent.iterdir() if p.read_bytes() != file.read_bytes()]
    if others:
        other = chance.choice(others)
        one, two = file.read_bytes(), other.read_bytes()
        file.write_bytes(two)
        other.write_bytes(one)


def repaired(path):
    """What `fic-sweep verify --repair` does, having found something."""
    report = verify.verify(path)
    assert report.problems
    if report.frame:
        verify.mend_frame(path)
        report = verify.verify(path)
    if report.bad_blocks:
        other = verify.recompute(open_store(path), report.bad_blocks, lambda p: None)
        assert not other
    return report


WAYS = [(flipped, 34, 1000), (cut_off, 17, 1000), (deleted, 16, 100), (folder_instead, 17, 100)]
WAYS += [(linked, 17, 100), (swapped, 14, 100)]


@pytest.mark.parametrize(("way", "ci", "torture"), WAYS)
def test_damage_is_found_and_repaired_to_the_same_bits(memory, stores, quick, way, ci, torture):
    chance, hit = random.Random(2), Counter()
    whole = stores.folder / "whole"
    files = [p.relative_to(whole) for p in sorted(whole.rglob("*")) if p.is_file()]
    files.remove(Path(LOCK))
    if way in (deleted, swapped):
        files.remove(Path(SEAL))  # a store may be without: a run was killed
    if way is swapped:
        files = [file for file in files if len(file.parts) == 2]
    for i in range(many(ci, torture)):
        with case(memory, whole) as path:
            name = files[i % len(files)]
            way(path / name, chance)
            hit[str(name)] += 1
            repaired(path)
            assert not verify.verify(path).problems, name
            assert contents(path) == stores.expected[5], name
            assert len(open_store(path).rows()) == 3
    assert len(hit) == len(files)
    tell(f"{sum(hit.values())} files {way.__name__}: all found, all repaired to the same bits")


def test_a_repair_writes_nothing_through_a_link(memory, stores, quick):
    with case(memory, stores.folder / "whole") as path:
        elsewhere = path.parent / "elsewhere"
        (path / "nmse").rename(elsewhere)
        (path / "nmse").symlink_to(elsewhere)
        assert [p.what for p in verify.verify(path).frame] == ["nmse"]
        (elsewhere / "zarr.json").write_text("precious")
        repaired(path)
        assert (elsewhere / "zarr.json").read_text() == "precious"
        assert not verify.verify(path).problems
        assert contents(path) == stores.expected[5]


@pytest.mark.parametrize("name", ["mine.txt", "nmse/c.3", "nmse/c.0.bak", "more/mine.txt"])
def test_what_is_no_part_of_a_store_is_found_and_left(memory, stores, quick, name):
    with case(memory, stores.folder / "whole") as path:
        (path / name).parent.mkdir(exist_ok=True)
        (path / name).write_text("precious")
        (problem,) = [p for p in verify.verify(path).problems if p.what == name]
        assert problem.foreign
        repaired(path)
        assert (path / name).read_text() == "precious"


class Victim:
    """A process at work on a store; `said` is what it told."""

    def __init__(self, context, path, programs):
        self.said, self.began = [], time.monotonic()
        self.pipe, theirs = context.Pipe(duplex=False)
        self.process = context.Process(target=work, args=(path, programs, theirs), daemon=True)
        self.process.start()
        theirs.close()

    def listen(self, seconds, done=math.inf):
        """For so long, or until it has done that many cells, or is at its end."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            if not self.pipe.poll(left):
                return
            try:
                self.said.append(self.pipe.recv())
            except EOFError:
                return
            self.ended = time.monotonic()
            if self.done >= done:
                return

    def kill(self):
        self.process.kill()
        self.process.join()
        self.listen(1)
        self.pipe.close()

    @property
    def done(self):
        return max((cells for cells in self.said if isinstance(cells, int)), default=0)


@pytest.fixture(scope="module")
def forks():
    """Processes with everything imported and nothing started, in a hundredth of a second."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.victim"])
    return context


def killed_in(path, victim):
    """In which phase a process was killed."""
    if victim.said and victim.said[-1] == "ended":
        return "after its end"
    if not path.exists():
        return "before there was a store"
    if list(path.rglob(f"*{PARTIAL}")) or (path / f"{NAME}-journal").exists():
        return "in a commit"
    rows = [row.files for row in open_store(path).rows()]
    if len(list(path.glob("*/c.*.*"))) > sum(len(files) for files in rows):
        return "in a commit"
    return "between two commits" if victim.done else "before its first block"


def test_killed_processes_lose_nothing(tmp_path, forks):
    """SIGKILL at a random time of a run, or just after it told of a block: while the next one is
    committed."""
    chance, phases, folder = random.Random(3), Counter(), tmp_path
    programs, path = folder / "programs", folder / "tiny.zarr"
    keeping = forks.Process(target=keep, args=(programs,))
    keeping.start()
    keeping.join()
    whole = Victim(forks, folder / "whole", programs)
    whole.listen(300)
    whole.process.join()
    assert whole.said[-2:] == [CELLS, "ended"]
    lasts, expected = whole.ended - whole.began, contents(folder / "whole")
    stores = kills = acknowledged = 0
    while kills < many(40, 1000) or path.exists():
        victim = Victim(forks, path, programs)
        if chance.random() < 0.5:
            victim.listen(chance.uniform(0, lasts))
        else:
            victim.listen(200, 0)  # how far it was
            left = BLOCKS - victim.done * BLOCKS // CELLS
            victim.listen(200, victim.done + chance.randrange(left + 1) * CELLS // BLOCKS)
            time.sleep(chance.uniform(0, 0.02))
        victim.kill()
        kills += 1
        phases[killed_in(path, victim)] += 1
        acknowledged = max(acknowledged, victim.done)
        if path.exists():
            true_to(path, expected, acknowledged)
        assert path.exists() or not acknowledged
        if "ended" in victim.said:
            assert contents(path) == expected
            assert not verify.verify(path).problems
            shutil.rmtree(path)
            stores, acknowledged = stores + 1, 0
    tell(f"{kills} kills, {stores} stores finished, a run of {lasts:.2f} s; killed {dict(phases)}")
    assert phases["in a commit"] + phases["between two commits"] > kills / 4
    assert phases["before its first block"] and phases["after its end"]


def test_a_store_that_became_another_is_refused(memory, stores, quick):
    """It was opened, then another process extended it."""
    with case(memory, stores.folder / "small") as path:
        opened = open_store(path)
        enlarge(path)
        with pytest.raises(SweepError, match="was changed by another process; try again"):
            run(opened)
        settle(path, stores)


def test_a_commit_survives_a_power_cut():
    """In SQLite's words: with EXTRA the journal's end, which is the commit, is flushed as well."""
    with tempfile.TemporaryDirectory() as folder:
        Ledger.create(Path(folder) / NAME)
        with _opened(Path(folder) / NAME, "rw") as database:
            assert database.execute("PRAGMA synchronous").fetchone() == (3,)
            assert database.execute("PRAGMA journal_mode").fetchone() == ("delete",)


@pytest.mark.parametrize("place", ["tiny.zarr", f".tiny.zarr{PARTIAL}"])
def test_a_second_process_is_refused_until_the_first_is_gone(
    memory, stores, quick, forks, place, capsys
):
    """One that changes a store, or one that is just making it."""
    made = place == "tiny.zarr"
    with case(memory, made and stores.folder / "begun") as path:
        owned = path.with_name(place)
        owned.mkdir(exist_ok=True)
        pipe, theirs = forks.Pipe(duplex=False)
        first = forks.Process(target=own, args=(owned, theirs), daemon=True)
        first.start()
        assert pipe.recv() == "owned"
        told = f"is being changed by process {first.pid} on {socket.gethostname()}"
        for deed in (go_on, mend) if made else (create,):
            with pytest.raises(SweepError, match=f"{place}: {told}; wait for it to end"):
                deed(path, stores, Told())
        if made:
            assert command(capsys, "resume", path)[:2] == (
                2,
                [f"{path}: {told}; wait for it to end"],
            )
        first.kill()
        first.join()
        settle(path, stores)


def command(capsys, *arguments):
    """`fic-sweep` in this process: its exit code, what it told, and what it printed.

    JAX and the signals stay as they are, and the tests go on.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atexit, "register", lambda _: None)
        patch.setattr(sys, "argv", ["fic-sweep", *map(str, arguments)])
        patch.setattr(runner, "configure", lambda *_: None)
        patch.setattr(signal, "signal", lambda *_: None)
        patch.setattr(warnings, "showwarning", warnings.showwarning)
        with pytest.raises(SystemExit) as end:
            cli.main()
    out, err = capsys.readouterr()
    return end.value.code, [line.removeprefix("fic-sweep: ") for line in err.splitlines()], out


def revoked_from(number):
    return lambda call: errno.EACCES if call.number >= number >= 0 else None


@pytest.fixture(scope="module")
def larger(memory):
    (memory / "whole.toml").write_text(TEXT)
    return memory / "whole.toml"


COMMANDS = [
    (["resume"], "begun"),
    (["resume", "--extend", "whole.toml"], "small"),
    (["verify", "--repair"], "damaged"),
    (["verify", "--repair"], "bad"),
]


@pytest.mark.parametrize("fault", [full_from, revoked_from])
@pytest.mark.parametrize(("asked", "source"), COMMANDS)
def test_what_the_system_refuses_is_one_line_and_exit_1(
    memory, stores, quick, larger, capsys, fault, asked, source
):
    arguments = [str(larger) if word == "whole.toml" else word for word in asked]
    calls, numbers, ended = [], [-1], Counter()
    while numbers:
        number = numbers.pop()
        with case(memory, stores.folder / source) as path:
            with Calls(path.parent, fault(number)) as disk:
                code, told, out = command(capsys, arguments[0], path, *arguments[1:])
            if number < 0:
                assert code == 0, (told, out)
                calls = disk.made
                numbers = list(range(0, len(calls), max(1, len(calls) // many(3, 200))))
            else:
                ended[code] += 1
                if told:  # of a damaged store whose ledger can't be read, what it is can't be told
                    (line,) = told
                    lost = source == "damaged" and ": is no result store" in line
                    assert (code == 2) if lost else (code == 1 and " kept" in line), line
                else:
                    assert code == 0 or (asked[0] == "verify" and "not as written" in out)
            if source in ("damaged", "bad") and verify.verify(path).problems:
                repaired(path)
            settle(path, stores)
    tell(f"{' '.join(asked)}: {fault.__name__} a call, exit codes {dict(ended)}")
    assert ended[1] > ended[0]


def test_a_folder_that_vanishes_ends_a_run_in_one_line(memory, stores, quick, capsys):
    with case(memory, stores.folder / "begun") as path:
        aside = path.with_name("aside")

        def fault(call):
            if call.name == "replace" and path.exists():
                disk._real["rename"](path, aside)

        with Calls(path.parent, fault) as disk:
            code, told, _ = command(capsys, "resume", path)
        assert (code, len(told)) == (1, 1)
        assert re.fullmatch(
            r"failed: .*No such file or directory; what was finished is kept if the folder is, "
            r"`fic-sweep resume .*tiny.zarr` does the rest",
            told[0],
        )
        aside.rename(path)
        settle(path, stores)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write where nobody may")
def test_a_read_only_folder_is_told_in_one_line(memory, stores, quick, capsys):
    with case(memory, stores.folder / "begun") as path:
        folders = [path, *(folder for folder in path.rglob("*") if folder.is_dir())]
        (path / LOCK).chmod(0o444)
        for folder in folders:
            folder.chmod(0o555)
        code, (line,), _ = command(capsys, "resume", path)
        assert (code, "Permission denied; 1 of 3 blocks are kept" in line) == (1, True), line
        for folder in folders:
            folder.chmod(0o755)
        (path / LOCK).chmod(0o644)
        settle(path, stores)
