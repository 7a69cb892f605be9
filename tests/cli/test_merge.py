"""`run --shard` and `merge`: what they print, and the one line where the request was wrong."""

import os
import re
import shutil
from pathlib import Path

import pytest
import xarray as xr

from tests.cli.conftest import TINY
from tests.cli.test_advice import advice, pasted
from tests.command import typed
from tests.store.stores import change_attributes, contents

RUN = ("run", "tiny.toml", "--chunk", "4")  # four blocks


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with tiny.toml, tiny.zarr, and two parts of the same sweep."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("tiny.toml").write_text(TINY)
        assert typed(*RUN).code == 0
        for k in (1, 2):
            ended = typed(*RUN, "--shard", f"{k}/2")
            assert ended.stdout.startswith(f"tiny.{k}-of-2.zarr: 6 scenarios in ")
    return folder


@pytest.fixture
def parts(made, tmp_path, monkeypatch):
    """The working directory: copies of them."""
    shutil.copytree(made, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    return sorted(tmp_path.glob("here/tiny.?-of-2.zarr"))


def test_a_merged_store_has_the_bits_of_one_run(parts):
    ended = typed("merge", *parts, "--out", "sub/all.zarr")
    assert ended.stdout == "sub/all.zarr: 12 scenarios of 2 parts\n"
    assert contents(Path("sub/all.zarr")) == contents(Path("tiny.zarr"))
    with xr.open_zarr("sub/all.zarr") as merged, xr.open_zarr("tiny.zarr") as one:
        assert merged.equals(one)
    for name in ("status", "verify", "resume"):
        assert typed(name, "sub/all.zarr").code == 0
    for command in (("--to", "csv"), ("--to", "parquet"), ("--to", "netcdf")):
        assert typed("export", "sub/all.zarr", *command).code == 0


def test_a_part_counts_its_own_blocks(parts):
    status = typed("status", "tiny.2-of-2.zarr").stdout
    assert "\nshard     2/2, 6 scenarios in 2 blocks\ndone      6 of 6 cells (100 %)\n" in status
    assert "blocks    0 of 2 to do\n" in status
    assert typed("resume", "tiny.2-of-2.zarr").stdout.endswith("complete already, 6 scenarios\n")
    again = typed(*RUN, "--shard", "2/2")
    assert again.stdout == "tiny.2-of-2.zarr: complete already, 6 scenarios\n"
    assert typed("verify", "tiny.2-of-2.zarr").code == 0
    assert typed("plot", "tiny.2-of-2.zarr", "--x", "Td", "--y", "K0").code == 0
    export = typed("export", "tiny.2-of-2.zarr", "--to", "csv")
    assert export.stderr == "fic-sweep: warning: 6 of them are of other shards than 2/2\n"


def test_a_dry_run_says_what_the_shard_has(parts):
    ended = typed(*RUN, "--shard", "1/3", "--dry-run")
    assert "\nshard     1/3, 4 scenarios in 1 block\n" in ended.stdout
    assert not os.path.exists("tiny.1-of-3.zarr")
    ended = typed(*RUN, "--shard", "1/2", "--dry-run")
    assert "warning: tiny.1-of-2.zarr exists already: `run` continues it" in ended.stderr


def test_a_repaired_part_is_its_own(parts):
    Path("tiny.1-of-2.zarr/zarr.json").unlink()
    Path("tiny.1-of-2.zarr/nmse/c.0.0").unlink()
    assert typed("verify", "tiny.1-of-2.zarr", "--repair").code == 0
    assert typed("merge", *parts, "--out", "all.zarr").code == 0
    assert contents(Path("all.zarr")) == contents(Path("tiny.zarr"))


@pytest.mark.parametrize("missing", [True, False])
def test_the_command_of_a_message_completes_the_parts(parts, missing):
    if missing:
        shutil.rmtree(parts[1])
    else:
        from sweeps.store.opening import open_store

        open_store(parts[1]).ledger.delete([1])
    os.rename("tiny.zarr", "one run.zarr")
    there = [part for part in parts if part.exists()]
    ended = typed("merge", *there)
    assert (ended.code, len(ended.stderr.splitlines())) == (2, 1)
    assert not os.path.exists("tiny.zarr")
    (command,) = advice(ended)
    assert pasted(command) == 0
    assert typed("merge", *parts).code == 0
    assert contents(Path("tiny.zarr")) == contents(Path("one run.zarr"))


def test_a_part_of_another_program_says_how_to_run_its_shard_again(parts):
    """In a job array each part gives the advice for itself, and all that is pasted merges."""
    for k, part in enumerate(parts, 1):
        change_attributes(part, jax="0.1")
        ended = typed(*RUN, "--shard", f"{k}/2")
        assert (ended.code, len(ended.stderr.splitlines())) == (2, 1)
        (command,) = advice(ended)
        assert f" --shard {k}/2 --chunk 4 --precision 32 --device cpu " in command
        assert pasted(command) == 0
    again = sorted(Path().glob("tiny-again.?-of-2.zarr"))
    assert typed("merge", *again).code == 0
    assert contents(Path("tiny-again.zarr")) == contents(Path("tiny.zarr"))


def test_the_shard_of_a_part_has_the_chunk_of_the_part(parts):
    ended = typed("run", "tiny.1-of-2.zarr", "--shard", "2/2", "--out", "new.zarr")
    assert ended.stdout.startswith("new.2-of-2.zarr: 6 scenarios in ")
    assert typed("merge", parts[0], "new.2-of-2.zarr", "--out", "all.zarr").code == 0
    ended = typed("run", "tiny.1-of-2.zarr", "--set", "t_end=1.0", "--dry-run")
    assert "\n1 block of up to 4 x 3\n" in ended.stdout  # another sweep has its own plan


def test_a_merge_without_a_shard_says_what_does_the_rest(parts):
    ended = typed("merge", parts[0], "--incomplete", "--out", "most.zarr")
    rest = "2 blocks still to run: `fic-sweep resume most.zarr` does"
    assert ended.stdout == f"most.zarr: 6 scenarios of 1 part; {rest}\n"
    assert pasted(*advice(ended)) == 0
    assert contents(Path("most.zarr")) == contents(Path("tiny.zarr"))


WRONG = [
    ([*RUN, "--shard", "3-40"], "--shard 3-40: must be K/N with whole numbers 1 <= K <= N <= 10,0"),
    ([*RUN, "--shard", "5/4"], "--shard 5/4: must be K/N"),
    ([*RUN, "--shard", "0/4"], "--shard 0/4: must be K/N"),
    ([*RUN, "--shard", ""], "--shard : must be K/N"),
    ([*RUN, "--shard", "1/5"], "--shard 1/5: N must be at most 4, the number of blocks of tiny; a"),
    ([*RUN, "--shard", "1/2", "--shard", "2/2"], "--shard takes one value, but is given 2"),
    (
        ["run", "tiny.toml", "--chunk", "2", "--shard", "1/2"],
        "tiny.1-of-2.zarr: was begun with another --chunk; --out names another",
    ),
    ([*RUN, "--set", "K0=[1,2,3,4]", "--shard", "1/2"], "begun with another sweep; --out"),
    ([*RUN, "--shard", "1/2", "--precision", "64"], "was begun with another --precision; --out"),
    (["merge"], "Missing argument 'PART...'"),
    (["merge", "none.zarr"], "none.zarr: is no result store: there is nothing of this name"),
    (["merge", "tiny.*-of-9.zarr"], "tiny.*-of-9.zarr: is no result store"),
    (["merge", "tiny.zarr"], "tiny.zarr: is the store of a whole sweep, not of a shard"),
    (["merge", "tiny.1-of-2.zarr", "tiny.1-of-2.zarr"], "is shard 1/2, and so is tiny.1-of-2.zarr"),
    (["merge", "tiny.1-of-2.zarr", "tiny.2-of-2.zarr"], "tiny.zarr: exists already; `fic-sweep"),
    (["merge", "tiny.1-of-2.zarr", "--out", "new.zarr"], "of 2 shards, 2 is missing (`fic-"),
    (["resume", "tiny.1-of-2.zarr", "--extend", "tiny.toml"], "tiny.1-of-2.zarr: is shard 1/2; `f"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "line"), WRONG, ids=lambda one: " ".join(one)[:50])
def test_a_wrong_request_is_one_line_and_changes_nothing(parts, arguments, line):
    before = {path: path.lstat().st_mtime_ns for path in Path().rglob("*")}
    ended = typed(*arguments)
    assert (ended.code, ended.stdout) == (2, "")
    assert len(ended.stderr.splitlines()) == 1
    assert re.match(f"fic-sweep: .*{re.escape(line)}", ended.stderr), ended.stderr
    assert {path: path.lstat().st_mtime_ns for path in Path().rglob("*")} == before
