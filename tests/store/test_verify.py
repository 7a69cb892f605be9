"""Damage of every kind, to every file of a store: found, and repaired to the same bits."""

import random
from collections import Counter

import pytest

from sweeps.store import verify
from sweeps.store.ledger import CHECKSUM
from sweeps.store.lock import LOCK
from sweeps.store.opening import Counts, dataset, open_store
from tests.store.stores import change_attributes, contents, enlarge, repaired, run
from tests.torture import many


def flipped(file, chance):
    content = bytearray(file.read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    file.write_bytes(content)


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
    """With another file of the same folder, if it has one."""
    others = [p for p in file.parent.iterdir() if p.read_bytes() != file.read_bytes()]
    if others:
        other = chance.choice(others)
        one, two = file.read_bytes(), other.read_bytes()
        file.write_bytes(two)
        other.write_bytes(one)


WAYS = [(flipped, 1000), (cut_off, 1000), (deleted, 100), (folder_instead, 100)]
WAYS += [(linked, 100), (swapped, 100)]


@pytest.mark.parametrize(("way", "torture"), WAYS)
def test_damage_is_found_and_repaired_to_the_same_bits(stores, quick, way, torture):
    chance, hit = random.Random(2), Counter()
    whole = stores.folder / "whole"
    files = [p.relative_to(whole).as_posix() for p in sorted(whole.rglob("*")) if p.is_file()]
    files.remove(LOCK)
    if way is deleted:
        files.remove(CHECKSUM)  # a killed run leaves none
    if way is swapped:
        files = [file for file in files if "/" in file]
    for i in range(many(len(files), torture)):
        with stores.case("whole") as path:
            name = files[i % len(files)]
            way(path / name, chance)
            hit[name] += 1
            repaired(path)
            assert not verify.verify(path).problems, name
            assert contents(path) == stores.expected[5], name
            assert len(open_store(path).rows()) == 3
    assert len(hit) == len(files)


def test_a_repair_writes_nothing_through_a_link(stores, quick):
    with stores.case("whole") as path:
        elsewhere = path.parent / "elsewhere"
        (path / "nmse").rename(elsewhere)
        (path / "nmse").symlink_to(elsewhere)
        assert [p.what for p in verify.verify(path).metadata] == ["nmse"]
        (elsewhere / "zarr.json").write_text("precious")
        repaired(path)
        assert (elsewhere / "zarr.json").read_text() == "precious"
        assert not verify.verify(path).problems
        assert contents(path) == stores.expected[5]


@pytest.mark.parametrize(
    "name",
    [
        "mine.txt", "nmse/c.3", "nmse/c.0.bak", "more/mine.txt",
        ".DS_Store", "status/.DS_Store", "status/._c.0", "status/Thumbs.db", "status/.nfs0001",
        "status/@eaDir/c.0", "K0/desktop.ini", "nmse/c.0.partial~",
    ],
)  # fmt: skip
@pytest.mark.parametrize("source", ["begun", "whole", "small"])
def test_a_foreign_file_is_named_and_left(stores, quick, source, name):
    """A file beside the blocks of `status` was taken for a block that is half written."""
    with stores.case(source) as path:
        (path / name).parent.mkdir(exist_ok=True)
        (path / name).write_text("precious")
        report = verify.verify(path)
        assert (report.problems, report.foreign[-1]) == ((), name)
        dataset(path)
        verify.repair_metadata(path)
        if source == "small":
            enlarge(path)
        run(open_store(path))
        assert (path / name).read_text() == "precious"
        assert not verify.verify(path).problems
        assert not Counts.of(open_store(path)).pending


def test_a_finished_store_that_lost_a_row_runs_its_block_again(stores, quick):
    """Its ledger is whole: only the time of the end says that a row is missing."""
    with stores.case("whole") as path:
        open_store(path).ledger.delete([1])
        (path / CHECKSUM).unlink()
        (problem,) = verify.verify(path).problems
        assert (problem.how, problem.block) == ("has no row of block 1", 1)
        repaired(path)
        assert contents(path) == stores.expected[5]


def test_a_record_that_lacks_only_its_end_is_as_written(stores, quick):
    """A kill between the ledger, which is first, and zarr.json."""
    with stores.case("whole") as path:
        change_attributes(path, end=None)
        assert not verify.verify(path).problems
        change_attributes(path, revision="another")
        assert [problem.what for problem in verify.verify(path).problems] == ["zarr.json"]
