"""Kills, failing calls and power cuts at every call: no acknowledged block is lost or wrong.

`make torture` tries every call, `make test` some of them (`many`).
"""

import errno
import multiprocessing
import os
import random
import re
import sys
from collections import Counter
from pathlib import Path

import pytest

from sweeps import runner
from sweeps.spec.mistakes import SweepError
from sweeps.store import extend, verify
from sweeps.store.fsync import PARTIAL
from sweeps.store.ledger import LEDGER
from sweeps.store.lock import LOCK
from sweeps.store.opening import open_store
from tests.command import typed
from tests.store import victim
from tests.store.faults import Calls, Disk, Killed, build
from tests.store.stores import TEXT, contents, enlarge, repaired, run
from tests.torture import many


def report(counted):
    """Print a count, for `make torture`."""
    sys.stdout.write(f"\n{counted}")


class Acknowledged:
    """The cells that a run said are on the disk."""

    cells = 0

    def __call__(self, progress):
        self.cells = progress.done


RECOMPUTED = [0, 2]


def resume(stores, path, tell):
    run(open_store(path), tell)


def recompute(stores, path, tell):
    runner.recompute(open_store(path), RECOMPUTED, tell)


def create(stores, path, tell):
    stores.create(path)


def enlarged(stores, path, tell):
    enlarge(path)


def repair(stores, path, tell):
    verify.repair_metadata(path)


# what happens, to which store, and the stride between the calls that `make test` tries
DEEDS = [
    (resume, "begun", 1),
    (recompute, "whole", 6),
    (create, None, 8),
    (enlarged, "small", 10),
    (repair, "damaged", 4),
]
deeds = pytest.mark.parametrize(
    ("deed", "source", "every"), DEEDS, ids=lambda d: getattr(d, "__name__", "")
)


def spoilt(stores, deed, source, every, fault, names=None):
    """Do it undisturbed; then again for each call, with a fault at that call."""
    calls, numbers = [], [-1]
    while numbers:
        number = numbers.pop()
        with stores.case(source) as path:
            acknowledged, failed = Acknowledged(), None
            with Calls(path.parent, fault(number)) as disk:
                try:
                    deed(stores, path, acknowledged)
                except (Killed, OSError, SweepError) as error:
                    failed = error
            if number < 0:
                calls = disk.made
                numbers = [call.number for call in calls if not names or call.name in names]
                numbers = numbers[:: many(every, 1)]
            yield path, calls[number] if number >= 0 else None, failed, acknowledged


def check(stores, path, deed, source, acknowledged, n):
    """The store is sound; every third one, also that it can be finished."""
    if path.exists() and source != "damaged":
        stores.sound(path, acknowledged.cells, RECOMPUTED if deed is recompute else ())
    if not n % many(3, 1):
        stores.settle(path, source == "damaged")


def killed_at(number):
    return lambda call: Killed if call.number == number else None


@deeds
def test_a_kill_at_any_call_loses_nothing(stores, quick, deed, source, every):
    cases = enumerate(spoilt(stores, deed, source, every, killed_at))
    for n, (path, call, failed, acknowledged) in cases:
        assert isinstance(failed, Killed) == (call is not None)
        check(stores, path, deed, source, acknowledged, n)
    report(f"{deed.__name__}: killed at {n} of its calls")


def broken_at(number):
    """One call fails, as on a bad sector; the next one works."""
    return lambda call: errno.EIO if call.number == number else None


FILLING = {"write", "pwrite", "create", "mkdir", "commit", "fsync"}  # calls that need room


def full_from(number):
    """The disk is full from a call on."""
    return lambda call: (
        errno.ENOSPC if call.number >= number >= 0 and call.name in FILLING else None
    )


def may_fail(call, store):
    """Whether a deed succeeds without this call: hints, checksums of the ledger, tidying.

    Also the lock of a zarr.json, which only tells whether the file system has locks.
    """
    aside = ("/owner.lock", "/ledger.sha256", ".zarr.before", "/ledger.sqlite")
    about = any(name in call.path for name in aside) and call.name != "commit"
    about |= call.path.endswith("/zarr.json") and call.name in ("open", "close")
    return about or call.name == "mkdir" or Path(call.path).name == store.name


@pytest.mark.parametrize("fault", [broken_at, full_from])
@deeds
def test_an_error_of_the_system_at_any_call_loses_nothing(
    stores, quick, deed, source, every, fault
):
    ended = 0
    for n, case in enumerate(spoilt(stores, deed, source, 2 * every, fault)):
        path, call, failed, acknowledged = case
        ended += bool(failed)
        if call and call.name not in ("unlink", "rmdir"):
            assert not list(path.parent.rglob(f"*{PARTIAL}")), call
            assert failed or fault is full_from or may_fail(call, path), call
        check(stores, path, deed, source, acknowledged, n)
    report(f"{deed.__name__}: {n} times {fault.__name__} a call, which ended it {ended} times")
    assert ended > n / 2


def short_at(number):
    """One write takes a third of its bytes."""
    return lambda call: 0.3 if call.number == number else None


def all_short_from(number):
    """Every write from one on takes some bytes only."""
    return lambda call: 0.01 if call.number >= number >= 0 else None


@pytest.mark.parametrize("fault", [short_at, all_short_from])
def test_a_short_write_continues(stores, quick, fault):
    n = -1
    for path, _, failed, acknowledged in spoilt(stores, resume, "begun", 1, fault, ["write"]):
        n += 1
        assert (failed, acknowledged.cells) == (None, 5)
        assert contents(path) == stores.expected[5]
    assert n > 6


def create_and_run(stores, path, tell):
    stores.create(path)
    run(open_store(path), tell)


# what happens, to which store, where, and the stride between the disks that `make test` finishes
CUTS = [
    (create_and_run, None, "new/folder/tiny.zarr", 16),
    (resume, "begun", "tiny.zarr", 4),
    (recompute, "whole", "tiny.zarr", 8),
    (enlarged, "small", "tiny.zarr", 16),
    (repair, "damaged", "tiny.zarr", 4),
]


@pytest.mark.parametrize(("deed", "source", "place", "every"), CUTS)
def test_a_power_cut_after_any_call_loses_nothing(stores, quick, deed, source, place, every):
    """The worst case loses every change without fsync; in the others a coin decides."""
    coin, acknowledged, cuts = random.Random(1), Acknowledged(), 0
    disks = {}  # each once, with the most that was acknowledged
    with stores.case(source) as path:
        folder = path.parent
        disk = Disk(folder)

        def after(call):
            nonlocal cuts
            disk.after(call)
            for share in (0, *many([0.5], [0.2, 0.5, 0.5, 0.8, 1])):
                left = disk.left(lambda share=share: coin.random() < share)
                disks[frozenset(left.items())] = (left, acknowledged.cells, call)
                cuts += 1

        with Calls(folder, after=after):
            deed(stores, folder / place, acknowledged)
    for i, (left, cells, call) in enumerate(disks.values()):
        with stores.case() as path:
            build(left, path.parent / "left")
            store = path.parent / "left" / place
            extend.recover(store)
            if cells or (source and deed is not repair):
                assert store.exists(), call
            if store.exists() and source != "damaged":
                stores.sound(store, cells, RECOMPUTED if deed is recompute else ())
            if not i % many(every, 1):
                stores.settle(store, source == "damaged")
    report(f"{deed.__name__}: {cuts} power cuts, {len(disks)} different disks")


def said(process, pipe):
    """What a process sent until its end."""
    process.join()
    sent = []
    while pipe.poll():
        try:
            sent.append(pipe.recv())
        except EOFError:
            break
    return sent


PHASES = [
    "before there is a store",
    "before the first block",
    "before a file is written",
    "before a file has its name",
    "between two names",
    "before the row",
    "between two blocks",
    "before the end",
    "after the end",
]


def phases(calls, path):
    """Phase -> number of the call before which a run is in it."""
    at = {}
    for call in calls:
        place = call.path.removeprefix(f"{path}/")
        here = {
            "before there is a store": call.name == "rename",
            "before the first block": call.name == "pwrite" and place == LOCK,
            "before a file is written": call.name == "write" and place == f"nmse/c.0{PARTIAL}",
            "before a file has its name": call.name == "replace" and place.startswith("nmse/c.0"),
            "between two names": call.name == "replace" and place.startswith("status/c.0"),
            "before the row": call.name == "commit" and "between two names" in at,
            "between two blocks": call.name == "pwrite" and "before the row" in at,
            "before the end": call.name == "replace" and place == f"zarr.json{PARTIAL}",
        }
        at |= {phase: call.number for phase in here if here[phase] and phase not in at}
    return at | {"after the end": len(calls)}


def test_a_killed_process_loses_nothing(stores, quick, processes):
    """SIGKILL in every phase of a run: the system frees the lock, and the next run continues."""
    with stores.case() as path, Calls(path.parent) as disk:
        create_and_run(stores, path, lambda progress: None)
    at = phases(disk.made, path)
    assert list(at) == PHASES
    for number in many(at.values(), range(len(disk.made) + 1)):
        with stores.case() as path:
            process, pipe = processes(victim.work, stores, path, number, None)
            sent = said(process, pipe)
            ended = number == len(disk.made)
            assert (process.exitcode, "ended" in sent) == ((0, True) if ended else (-9, False))
            cells = max((n for n in sent if n != "ended"), default=0)
            assert path.exists() == (number > at["before there is a store"])
            if path.exists():
                stores.sound(path, cells)
            stores.settle(path)
    report(f"SIGKILL at {len(many(at, disk.made))} calls of a run")


@pytest.mark.skipif(not many(0, 1), reason="`make torture`")
def test_a_process_that_is_killed_at_any_time_loses_nothing(stores, quick, processes):
    """At random times, with the thread that commits beside the one that computes."""
    chance, kills = random.Random(3), 0
    for _ in range(500):
        with stores.case() as path:
            sent = []
            for seconds in (*(chance.uniform(0.005, 0.08) for _ in range(5)), 1e6):
                sent += said(*processes(victim.work, stores, path, None, seconds))
                if path.exists():
                    stores.sound(path, max((n for n in sent if n != "ended"), default=0))
                if "ended" in sent:
                    break
                kills += 1
            assert contents(path) == stores.expected[5]
    report(f"500 stores, killed {kills} times")


@pytest.mark.parametrize("place", ["tiny.zarr", f".tiny.zarr{PARTIAL}"])
def test_a_second_process_is_refused_until_the_first_is_gone(stores, quick, processes, place):
    """While the first one changes a store, or makes it."""
    changes = place == "tiny.zarr"
    with stores.case(changes and "begun") as path:
        path.with_name(place).mkdir(exist_ok=True)
        first, pipe = processes(victim.hold, path.with_name(place))
        assert pipe.recv() == "locked"
        reason = f"{place}: is being changed by process {first.pid} on .*; wait for it to end"
        for deed in (resume, repair) if changes else (create,):
            with pytest.raises(SweepError, match=reason):
                deed(stores, path, None)
        if changes:
            refused = typed("resume", path)
            assert refused.code == 2
            assert re.fullmatch(rf"fic-sweep: .*{reason}\n", refused.stderr)
        first.kill()
        first.join()
        stores.settle(path)


@pytest.fixture
def half_written(stores, quick):
    """A finished store whose ledger has a half-written commit and its journal."""
    with stores.case("whole") as path:
        context = multiprocessing.get_context("forkserver")
        process = context.Process(target=victim.half_a_commit, args=(path / LEDGER,))
        process.start()
        process.join()
        assert process.exitcode == -9
        assert (path / f"{LEDGER}-journal").stat().st_size > 4000
        yield path


def test_a_reader_rolls_back_a_half_written_commit(stores, half_written):
    assert [row.block for row in open_store(half_written).rows()] == [0, 1, 2]
    stores.settle(half_written)


def test_a_repair_keeps_the_journal_out_of_the_new_ledger(stores, half_written):
    """The old ledger is missing, so that SQLite would play its journal into the new one."""
    (half_written / LEDGER).unlink()
    verify.repair_metadata(half_written)
    assert open_store(half_written).rows() == []
    stores.settle(half_written)


def revoked_from(number):
    """Every call from one on lacks the permission."""
    return lambda call: errno.EACCES if call.number >= number >= 0 else None


COMMANDS = [
    (["resume"], "begun"),
    (["resume", "--extend", "whole.toml"], "small"),
    (["verify", "--repair"], "damaged"),
    (["verify", "--repair"], "bad"),
]


@pytest.mark.parametrize("fault", [full_from, revoked_from])
@pytest.mark.parametrize(("asked", "source"), COMMANDS)
def test_a_refusal_of_the_system_is_one_line_and_exit_1(
    stores, quick, tmp_path, fault, asked, source
):
    (tmp_path / "whole.toml").write_text(TEXT)
    name, *options = [tmp_path / word if word == "whole.toml" else word for word in asked]
    ended = Counter()

    def command(stores, path, _):
        nonlocal done
        done = typed(name, path, *options)

    done, stride = None, {"begun": 25, "small": 60, "damaged": 40, "bad": 40}[source]
    for path, call, _, _ in spoilt(stores, command, source, stride, fault):
        if call is None:
            assert done.code == 0, done
        else:
            ended[done.code] += 1
            if done.stderr:
                # of a damaged store whose ledger can't be read, nothing is known
                (line,) = done.stderr.splitlines()
                lost = source == "damaged" and ": is no result store" in line
                assert (done.code == 2) if lost else (done.code == 1 and " kept" in line), line
            else:
                assert done.code == 0 or (name == "verify" and "not as written" in done.stdout)
        if source in ("damaged", "bad") and verify.verify(path).problems:
            repaired(path)
        stores.settle(path)
    assert ended[1] > ended[0]


def test_a_folder_that_vanishes_ends_a_run_in_one_line(stores, quick):
    with stores.case("begun") as path:
        aside = path.with_name("aside")

        def fault(call):
            if call.name == "replace" and path.exists():
                disk._real["rename"](path, aside)

        with Calls(path.parent, fault) as disk:
            done = typed("resume", path)
        assert done.code == 1
        assert re.fullmatch(
            r"fic-sweep: failed: .*No such file or directory; what was finished is kept if the "
            r"folder is, `fic-sweep resume .*tiny.zarr` does the rest\n",
            done.stderr,
        )
        aside.rename(path)
        stores.settle(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_ends_a_run_in_one_line(stores, quick):
    with stores.case("begun") as path:
        folders = [path, *(folder for folder in path.rglob("*") if folder.is_dir())]
        (path / LOCK).chmod(0o444)
        for folder in folders:
            folder.chmod(0o555)
        done = typed("resume", path)
        assert done.code == 1
        assert "Permission denied; 1 of 3 blocks are kept" in done.stderr
        for folder in folders:
            folder.chmod(0o755)
        (path / LOCK).chmod(0o644)
        stores.settle(path)
