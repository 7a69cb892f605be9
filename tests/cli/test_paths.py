"""Whatever a user types as a path gets the place, or one line and exit code 2."""

import shutil

import pytest

from tests.command import typed

RUN = ["run", "tiny.toml", "--out"]
PLOT = ["plot", "tiny.zarr", "--x", "Td", "--y", "K0", "--out"]
EXPORT = ["export", "tiny.zarr", "--to", "csv", "--out"]


@pytest.fixture
def copied(ran, folder):
    shutil.copytree(ran / "tiny.zarr", folder / "tiny.zarr")
    return folder


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ([*RUN, "x/.."], "exists already; --out names another"),
        ([*RUN, "."], "exists already"),
        ([*RUN, "tiny.toml"], "tiny.toml: exists already"),
        ([*RUN, "tiny.zarr/"], "`fic-sweep resume tiny.zarr` continues it"),
        ([*RUN, "/"], "/: is no result store"),
        ([*RUN, ""], "is empty"),
        ([*RUN, "a\nb"], r"a\nb: a path must have no control characters"),
        ([*RUN, "tiny.toml/x"], "Not a directory"),
        ([*RUN, "nowhere"], "is a link to gone, where nothing is"),
        ([*RUN, "new/" + "x" * 250], "File name too long"),
        ([*PLOT, ""], "is empty"),
        ([*PLOT, "nowhere"], "is a link to gone, where nothing is"),
        ([*EXPORT, ""], "is empty"),
        ([*EXPORT, "nowhere"], "is a link to gone, where nothing is"),
        (["status", ""], "is empty"),
        (["status", "/"], "/: is no result store"),
        (["resume", "/"], "/: is no result store"),
        (["verify", "/"], "/: is no result store"),
        (["resume", "."], "; in it are the stores "),
        (["status", "none.zarr"], "none.zarr: is no result store: there is nothing of this name"),
        (["status", "tiny.toml"], "it is a sweep file; `fic-sweep run tiny.toml` makes a store"),
        (["status", "table.nc"], "it is an exported file; name the store that it was made from"),
        (["verify", "table.nc"], "it is an exported file; name the store that it was made from"),
        (["status", "tiny.zarr/zarr.json"], "it is a file, and a store is a folder"),
        (["status", "nowhere"], "gone: is no result store"),
        (["show", "a\nb"], r"a\nb: is no file and no sweep of the library"),
        (["show", "a\nb.toml"], r"a\nb.toml: there is no such file"),
        (["report", "--results", ""], "is empty"),
        (["report", "--results", "tiny.toml"], "tiny.toml: is no folder"),
        (["report", "--docs", "a\nb"], "no control characters"),
    ],
    ids=lambda words: " ".join(words)[:30].encode("unicode_escape").decode() if words else "",
)
def test_a_path_that_can_not_be_used_is_refused_in_one_line(copied, command, words):
    (copied / "nowhere").symlink_to("gone")
    (copied / "table.nc").write_bytes(b"\x89HDF\r\n")
    before = sorted(copied.rglob("*"))
    ended = typed(*command)
    assert (ended.code, ended.stdout) == (2, "")
    assert words in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert sorted(copied.rglob("*")) == before


def test_every_command_works_inside_the_store(copied, monkeypatch):
    monkeypatch.chdir("tiny.zarr")
    for command in (
        ["status", "."],
        ["verify", "."],
        ["resume", "."],
        ["resume", "../tiny.zarr/."],
    ):
        ended = typed(*command)
        assert (ended.code, ended.stderr) == (0, "")
        assert ended.stdout.startswith(f"{copied / 'tiny.zarr'}: ")


def test_an_extension_says_how_to_enter_the_new_folder(copied, monkeypatch):
    """It replaces the folder that somebody stands in; the advice is followed here."""
    larger = (copied / "tiny.toml").read_text().replace("12.0]", "12.0, 15.0]")
    (copied / "larger.toml").write_text(larger)
    monkeypatch.chdir(copied / "tiny.zarr")
    ended = typed("resume", ".", "--extend", "../larger.toml")
    assert ended.code == 0
    assert 'warning: the store has a new folder; `cd "$PWD"` enters it' in ended.stderr
    monkeypatch.chdir(copied / "tiny.zarr")  # what `cd "$PWD"` does
    assert "16 of 16 cells" in typed("status", ".").stdout


def test_extend_keeps_a_link_to_the_store(copied):
    (copied / "disk").mkdir()
    (copied / "tiny.zarr").rename(copied / "disk" / "tiny.zarr")
    (copied / "tiny.zarr").symlink_to("disk/tiny.zarr")
    larger = (copied / "tiny.toml").read_text().replace("12.0]", "12.0, 15.0]")
    (copied / "larger.toml").write_text(larger)
    ended = typed("resume", "tiny.zarr", "--extend", "larger.toml")
    assert (ended.code, ended.stderr) == (0, "")
    assert (copied / "tiny.zarr").is_symlink()
    assert [p.name for p in (copied / "disk").iterdir()] == ["tiny.zarr"]
    assert "16 of 16 cells" in typed("status", "tiny.zarr").stdout
