"""Shards and their merge: the bits of one run, whatever was killed, or one line and no change."""

import errno
import json
import math
import os
import random
import shutil
import sys

import numpy as np
import pytest

from sweeps import merge as merging
from sweeps import runner
from sweeps.merge import merge
from sweeps.plan import shard
from sweeps.plan.grid import Grid, cells_of
from sweeps.plan.shard import Shard
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from sweeps.store import extend
from sweeps.store.create import partial_of
from sweeps.store.fsync import PARTIAL
from sweeps.store.ledger import DONE, Row
from sweeps.store.opening import Counts, dataset, open_store
from sweeps.store.verify import verify
from tests.store import victim
from tests.store.faults import Calls, Disk, Killed, build, refusing
from tests.store.stores import TEXT, WHOLE, change_attributes, contents, flip, run
from tests.torture import many

# 99 blocks of two cells, or of one
MANY = parse(TEXT.replace("[1.0, 2.0, 3.0, 4.0, 5.0]", "{ lin = [1.0, 65.0], n = 65 }")
             .replace("[axes]", "[axes]\nTd = [1.0, 2.0, 3.0]"), "many")  # fmt: skip


def part_of(path, shard, plan=WHOLE):
    """Run a shard of the sweep of `path`; returns the path of its part."""
    share = Shard.parse(shard)
    part = share.part(path)
    run(runner.start_or_reopen(part, plan, 2, 32, share))
    return part


def parts_of(path, n, plan=WHOLE):
    return [part_of(path, f"{k}/{n}", plan) for k in range(1, n + 1)]


def sound(paths):
    for path in paths:
        assert not verify(path).problems
        assert not Counts.of(open_store(path)).pending


@pytest.mark.parametrize("n", [1, 2, 7, 40, 99])
def test_shards_have_each_block_once(n):
    grids = [Grid(MANY, 2, Shard(k, n)) for k in range(1, n + 1)]
    assert sorted(i for grid in grids for i in grid.own) == list(range(99))
    for grid in grids:
        assert grid.own_cells == sum(cells_of(grid.block(index)) for index in grid.own)
        assert [i for i in range(-1, 101) if grid.owns(i)] == list(grid.own)
    assert max(len(g.own) for g in grids) - min(len(g.own) for g in grids) <= 1


def test_the_blocks_of_a_shard_are_those_of_any_version():
    """Parts of a sweep may be made months apart. Another rule needs another `shard.RULE`."""
    assert shard.RULE == "golden"
    blocks = [0, 6, 8, 15, 17, 20, 26, 29, 35]
    assert Shard(1, 4).blocks(37) == blocks


@pytest.mark.parametrize("counts", [(12, 8), (7, 8, 5), (5, 16), (40, 40), (9, 10, 10), (30, 9)])
def test_shards_of_a_sweep_cost_about_the_same(counts):
    """Along an axis a scenario costs up to 10 times as much, and N divides its last axis."""
    n_blocks, last = math.prod(counts), counts[-1]
    for n in (n for n in range(2, last + 1) if last % n == 0):
        for along, length in zip(np.indices(counts).reshape(len(counts), -1), counts, strict=True):
            cost = 10 ** (along / length)
            each = [cost[Shard(k, n).blocks(n_blocks)].sum() for k in range(1, n + 1)]
            # a block more or less; with every N-th block it is up to 2 times the mean
            assert max(each) - min(each) <= cost.max() + 0.1 * np.mean(each)


def test_a_part_that_was_divided_in_another_way_is_refused(stores, quick):
    with stores.case() as path:
        parts = parts_of(path, 2)
        for value in ("other", None):
            change_attributes(parts[0], shard_rule=value)
            line = "is shard 1/2 of another version of fic-sweep, which divides the blocks in"
            refused(parts, path, line)
            with pytest.raises(SweepError, match=line):
                part_of(path, "1/2")


@pytest.mark.parametrize(
    "text", ["3-40", "5/4", "0/4", "0/0", "-1/4", "1/2/3", "", "1.0/2", "1/10001", "¹/2", " 1/2"]
)
def test_what_is_no_shard_is_refused(text):
    with pytest.raises(SweepError, match=r"--shard .*: must be K/N with whole numbers 1 <= K <= N"):
        Shard.parse(text)


def test_the_store_of_a_part_has_its_name(tmp_path):
    for name in ("tiny.zarr", "tiny"):
        part = Shard(3, 40).part(tmp_path / name)
        assert part == tmp_path / "tiny.3-of-40.zarr"
        assert Shard(3, 40).whole(part) == tmp_path / "tiny.zarr"
    assert Shard(3, 40).whole(tmp_path / "other.zarr") == tmp_path / "other.zarr"


def test_forty_shards_of_which_five_were_killed_are_one_run(stores, quick, processes):
    with stores.case() as path:
        one = path.with_name("one.zarr")
        run(runner.start(one, MANY, 2, 32))
        with stores.case() as aside, Calls(aside.parent) as disk:
            part_of(aside, "40/40", MANY)  # the fewest blocks
        calls = len(disk.made)
        killed = dict(
            zip((4, 9, 21, 33, 40), np.linspace(10, calls - 5, 5).astype(int), strict=True)
        )
        for k in range(1, 41):
            if k in killed:
                shard = Shard(k, 40)
                arguments = (shard.part(path), MANY, shard, killed[k])
                process, _ = processes(victim.run_shard, *arguments)
                process.join()
                assert process.exitcode == -9
        parts = [path.with_name(f"tiny.{k}-of-40.zarr") for k in range(1, 41)]
        assert 1 < sum(p.exists() for p in parts) <= 5
        assert parts_of(path, 40, MANY) == parts
        merge(parts, path)
        merged, whole = contents(path), contents(one)
        for files in (merged, whole):  # a process of the test has fewer devices than the test
            del files["zarr.json"]["attributes"]["device"]
        assert merged == whole
        sound([path, *parts])
        assert {k: v.values.tobytes() for k, v in dataset(path).variables.items()} == {
            k: v.values.tobytes() for k, v in dataset(one).variables.items()
        }


def test_one_shard_is_the_whole(stores, quick):
    with stores.case() as path:
        part = part_of(path, "1/1")
        assert contents(merge([part]).path) == stores.expected[5]
        assert open_store(part).grid.shard == Shard(1, 1)


def test_more_shards_than_blocks_are_refused(stores, quick):
    with stores.case() as path:
        with pytest.raises(SweepError, match="N must be at most 3, the number of blocks of tiny"):
            part_of(path, "1/4")
        assert not list(path.parent.iterdir())


def test_the_merged_store_says_what_made_it(stores, quick, monkeypatch):
    with stores.case() as path:
        made_by = runner.provenance(32)
        first = part_of(path, "1/2")
        monkeypatch.setattr(runner, "provenance", lambda _: made_by | {"device": "16 x cpu"})
        attributes = merge([part_of(path, "2/2"), first]).group.attrs.asdict()
        assert attributes["device"] == f"{made_by['device']}, 16 x cpu"
        said = json.loads(attributes["parts"])
        assert [part["shard"] for part in said] == ["1/2", "2/2"]
        assert attributes["start"] == min(part["start"] for part in said)
        assert attributes["end"] == max(part["end"] for part in said)
        assert not {"shard", "shard_rule"} & attributes.keys()


@pytest.mark.parametrize("links", [True, False])
def test_files_are_linked_or_else_copied(stores, quick, monkeypatch, links):
    with stores.case() as path:
        parts = parts_of(path, 2)
        before = [contents(part) for part in parts]
        with monkeypatch.context() as patch:
            if not links:
                patch.setattr(os, "link", refusing(errno.EXDEV))
            merge(parts)
        same = os.path.samefile(parts[0] / "nmse" / "c.0", path / "nmse" / "c.0")
        assert same == links
        assert not os.path.samefile(parts[0] / "zarr.json", path / "zarr.json")
        extend_by_one(path)  # nothing that is done to the store changes a part
        for part in parts[1:]:
            shutil.rmtree(part)
        assert contents(parts[0]) == before[0]
        sound([path, parts[0]])


def extend_by_one(path):
    larger = parse(TEXT.replace("5.0]", "5.0, 6.0]"), "larger")
    run(extend.extend(open_store(path), larger, "larger"))


def test_a_merged_store_can_grow_and_a_part_can_not(stores, quick):
    with stores.case() as path:
        parts = parts_of(path, 3)
        with pytest.raises(SweepError, match=r"is shard 1/3; .* how all become one store"):
            extend_by_one(parts[0])
        merge(parts)
        extend_by_one(path)
        assert dataset(path).sizes["K0"] == 6
        assert "parts" in open_store(path).group.attrs
        sound([path])


def test_a_merge_without_some_blocks_is_resumed(stores, quick, monkeypatch):
    with stores.case() as path:
        parts = parts_of(path, 3)
        shutil.rmtree(parts[1])
        monkeypatch.setattr(runner, "_compute", lambda *_: 1 / 0)
        open_store(parts[2]).ledger.delete([2])
        part_of(path, "3/3")  # sets its block aside
        monkeypatch.undo()
        line = (
            r"tiny.zarr: of 3 shards, 2 is missing \(`fic-sweep run .*tiny.1-of-3.zarr "
            r"--shard 2/3 --chunk 2 --precision 32 --device cpu --out .*tiny.zarr` runs 2\), "
            r"and 3 is unfinished \(`fic-sweep resume .*tiny.3-of-3.zarr` goes on with 3\); "
            r"--incomplete merges what"
        )
        refused([parts[0], parts[2]], path, line)
        counts = Counts.of(merge([parts[2], parts[0]], incomplete=True))
        assert (counts.pending, [row.block for row in counts.set_aside]) == ([1, 2], [2])
        victim.without_engine(monkeypatch)
        run(open_store(path))
        assert contents(path) == stores.expected[5]


def refused(parts, path, line, error=SweepError):
    """A merge is refused in one line, and changes nothing."""
    before = sorted(path.parent.rglob("*"))
    with pytest.raises(error, match=line) as raised:
        merge(parts, path)
    assert len(str(raised.value).splitlines()) == 1
    assert sorted(path.parent.rglob("*")) == before


def test_numbers_are_named_with_neighbours_together():
    for numbers, text in (([3], "3 is"), ([1, 2], "1 to 2 are"), ([1, 3, 4, 5], "1, 3 to 5 are")):
        assert merging._numbers(numbers) == text


OTHER = {
    "sweep": ({"plan": parse(TEXT.replace("5.0]", "6.0]"), "other")}, "another sweep than"),
    "shards": ({"n": 3}, "another number of shards than"),
    "chunk": ({"chunk": 1}, "another --chunk than"),
    "estimate": (
        {"plan": WHOLE.model_copy(update={"error_estimate": True})}, "another --error-estimate"),
    "precision": ({"precision": 64}, "another program than .*: dtype is float64, not float32"),
    "library": ({"made_by": {"jax": "0.9"}}, r"another program than .*: jax is 0.9, not 0\.\d+"),
    "arithmetic": ({"made_by": {"arithmetic": "xla"}}, "program than .*: arithmetic is xla, not"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "line"), OTHER.values(), ids=OTHER)
def test_parts_of_two_runs_are_refused(stores, quick, monkeypatch, change, line):
    with stores.case() as path:
        first, shard = part_of(path, "1/2"), Shard(2, change.get("n", 2))
        precision, made_by = change.get("precision", 32), change.get("made_by", {})
        monkeypatch.setattr(runner, "provenance", provenance_with(made_by))
        options = (change.get("plan", WHOLE), change.get("chunk", 2), precision, shard)
        runner.start(path.with_name("other.zarr"), *options)
        refused([first, path.with_name("other.zarr")], path, rf"other.zarr: was .*{line}")


def provenance_with(made_by, real=runner.provenance):
    return lambda precision: real(precision) | made_by


def test_what_is_no_set_of_parts_is_refused(stores, quick):
    with stores.case() as path:
        parts = parts_of(path, 2)
        whole = path.with_name("whole.zarr")
        run(runner.start(whole, WHOLE, 2, 32))
        copy = shutil.copytree(parts[0], path.with_name("copy.zarr"))
        twice = r"is shard 1/2, and so is .*tiny.1-of-2.zarr; name one"
        refused([*parts, parts[0]], path, twice)
        refused([*parts, copy], path, f"copy.zarr: {twice}")
        refused([whole], path, "whole.zarr: is the store of a whole sweep, not of a shard")
        refused([*parts, path.with_name("none.zarr")], path, "there is nothing of this name")
        refused(parts, whole, "whole.zarr: exists already; ")
        refused(parts, parts[0] / "new.zarr", "lies in the store ")


def test_a_damaged_part_is_refused(stores, quick):
    with stores.case() as path:
        parts = parts_of(path, 2)
        flip(parts[1] / "nmse" / "c.1", 99)
        refused(parts, path, r"tiny.2-of-2.zarr: nmse/c.1 is not as it was written; `fic-sweep ver")
        (parts[1] / "nmse" / "c.1").unlink()
        refused(parts, path, "lacks nmse/c.1, of finished blocks")
        flip(parts[0] / "K0" / "c.0", 99)
        refused(parts, path, "tiny.1-of-2.zarr: K0/c.0 is not as it was written")


def test_a_part_has_no_block_of_another_shard(stores, quick):
    with stores.case() as path:
        parts = parts_of(path, 2)
        open_store(parts[0]).ledger.insert([Row(1, DONE)])
        refused(parts, path, "is damaged: it has a block 1;")
        assert verify(parts[0]).problems


def test_a_part_that_is_running_is_refused(stores, quick, processes):
    with stores.case() as path:
        parts = parts_of(path, 2)
        process, pipe = processes(victim.hold, parts[1])
        assert pipe.recv() == "locked"
        refused(parts, path, f"is being changed by process {process.pid} on .*; wait for it to end")
        process.kill()
        process.join()
        merge(parts)


def test_a_part_can_not_change_while_it_is_merged(stores, quick, monkeypatch):
    """`verify --repair` of a part deletes rows and files."""
    with stores.case() as path:
        parts, take, tried = parts_of(path, 2), merging._take, []

        def during(file, target):
            if file == parts[0] / "status" / "c.0":
                tried.append(file)
                with pytest.raises(
                    SweepError, match="is being merged by another process; wait for it"
                ):
                    run(open_store(parts[0]))
            take(file, target)

        monkeypatch.setattr(merging, "_take", during)
        assert contents(merge(parts).path) == stores.expected[5]
        assert tried


def test_a_full_disk_leaves_nothing(stores, quick, monkeypatch):
    with stores.case() as path:
        parts = parts_of(path, 2)
        monkeypatch.setattr(os, "link", refusing(errno.EXDEV))
        monkeypatch.setattr(shutil, "copyfile", refusing(errno.ENOSPC))
        refused(parts, path, "can't be written: No space left on device", OSError)
        monkeypatch.undo()
        merge(parts)


def killed_at(number):
    return lambda call: Killed if call.number == number else None


def test_a_kill_at_any_call_of_a_merge_leaves_the_parts_and_no_half_store(stores, quick):
    with stores.case() as path:
        parts = parts_of(path, 2)
        with Calls(path.parent) as disk:
            merge(parts)
        for number in range(0, len(disk.made), many(7, 1)):
            shutil.rmtree(path)
            with pytest.raises(Killed), Calls(path.parent, killed_at(number)):
                merge(parts)
            if not path.exists():
                merge(parts)
            assert contents(path) == stores.expected[5]
            assert not partial_of(path).exists()
        sound([path, *parts])
    sys.stdout.write(f"\nmerge: killed at {len(disk.made)} calls")


def test_a_killed_merge_is_made_again(stores, quick, processes):
    with stores.case() as path:
        parts = parts_of(path, 3)
        with Calls(path.parent) as disk:
            merge(parts)
        shutil.rmtree(path)
        links = [call.number for call in disk.made if call.name == "link"]
        for number in (links[len(links) // 2], links[-1]):
            process, _ = processes(victim.merge_parts, parts, path, number)
            process.join()
            assert process.exitcode == -9
            assert partial_of(path).exists()
            assert not path.exists()
        assert contents(merge(parts).path) == stores.expected[5]
        assert not list(path.parent.glob(f"*{PARTIAL}"))
        sound([path, *parts])


def test_a_power_cut_after_any_call_of_a_merge_leaves_the_parts_and_no_half_store(stores, quick):
    """The worst case loses every change without fsync; in the others a coin decides."""
    coin, lefts = random.Random(1), {}
    with stores.case() as path:
        parts, folder = parts_of(path, 2), path.parent
        disk = Disk(folder)

        def after(call):
            disk.after(call)
            for share in (0, *many([0.5], [0.2, 0.5, 0.5, 0.8, 1])):
                left = disk.left(lambda share=share: coin.random() < share)
                lefts[frozenset(left.items())] = left

        with Calls(folder, after=after):
            merge(parts)
        assert any("/tiny.zarr" in left for left in lefts.values())
    sys.stdout.write(f"\nmerge: {len(lefts)} different disks after power cuts")
    for left in list(lefts.values())[:: many(8, 1)]:
        with stores.case() as path:
            build(left, path.parent / "left")
            store = path.parent / "left" / "tiny.zarr"
            if not store.exists():
                merge([store.with_name(part.name) for part in parts], store)
            assert contents(store) == stores.expected[5]


def test_a_command_of_a_job_array_is_repeated(stores, quick):
    with stores.case() as path:
        part = part_of(path, "1/2")
        open_store(part).ledger.delete([0])
        assert part_of(path, "1/2") == part  # what a requeued job does
        sound([part])
        for change, line in (
            ({"plan": MANY}, "begun with another sweep; --out names another"),
            ({"chunk": 1}, "begun with another --chunk; "),
            ({"shard": Shard(2, 2)}, "begun with another --shard; "),
            ({"precision": 64}, "begun with another --precision; "),
        ):
            arguments = {"plan": WHOLE, "chunk": 2, "precision": 32, "shard": Shard(1, 2)} | change
            with pytest.raises(SweepError, match=line):
                runner.start_or_reopen(part, **arguments)
        change_attributes(part, jax="0.1")
        with pytest.raises(SweepError, match=r"begun by another program \(jax was 0.1, is "):
            part_of(path, "1/2")
        sound([])


def test_the_shards_of_a_reduction_are_one_run(stores):
    text = TEXT.replace("[axes]", "[time]\nt_end = 0.2\n[axes]\nTd = [1.0, 2.0, 3.0]")
    text = text.replace('metrics = ["nmse", "peak_torque"]\n', "")
    plan = parse(text + '[reduce]\nover = ["K0"]\nmax = ["nmse"]\nmean = ["energy_in"]', "reduced")
    with stores.case() as path:
        one = path.with_name("one.zarr")
        run(runner.start(one, plan, 1, 32))
        parts = []
        for k in (1, 2):
            share = Shard(k, 2)
            parts.append(share.part(path))
            run(runner.start_or_reopen(parts[-1], plan, 1, 32, share))
        merge(parts, path)
        sound([path, *parts])
        assert contents(path) == contents(one)
