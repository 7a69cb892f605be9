"""Names, files and pipes as sweeps: what `show`, `run` and `resume --extend` take and refuse."""

import os
import re

import pytest

from sweeps.spec.types import SpacedRange
from tests.command import call, typed


def test_show_reads_a_pipe_once(folder):
    """`show <(command)`: what was read is printed."""
    read, write = os.pipe()
    text = (folder / "tiny.toml").read_bytes()
    os.write(write, text)
    os.close(write)
    shown = typed("show", f"/dev/fd/{read}")
    os.close(read)
    assert shown.stdout.startswith(text.decode())


def test_a_file_with_the_name_of_a_library_sweep_is_named(folder):
    (folder / "atlas.toml").write_text((folder / "tiny.toml").read_text())
    shown = typed("show", "atlas")
    assert "10,378,500 scenarios" in shown.stdout
    warning = "warning: atlas is the library's sweep; atlas.toml is the file in this folder\n"
    assert warning in shown.stderr
    assert "= 12 scenarios" in typed("show", "atlas.toml").stdout


def test_show_lists_what_is_held_and_marks_defaults(folder):
    shown = typed("show", "tiny.toml").stdout
    held = re.search(r"# held (.*?)# default (.*?)# model (.*)", shown, re.DOTALL)
    named, default, model = (" ".join(part.replace("#", "").split()) for part in held.groups())
    assert "dt = 0.01 s, t_end = 0.5 s" in named
    for text in ("Fmax = 15 N*m", "I = 10 kg*m^2", "period = 0.01 s", "Denv = 189.7 N*m*s/rad"):
        assert text in default
    assert "K0" not in named + default and "Td" not in named + default
    assert "law algorithm1 (default)" in model
    assert max(map(len, shown.splitlines())) <= 100


def test_status_and_dry_run_list_it_too(ran):
    for command in (("status", "tiny.zarr"), ("run", "tiny.toml", "--dry-run", "--out", "b.zarr")):
        printed = typed(*command).stdout
        assert "\nheld      dt = 0.01 s, t_end = 0.5 s" in printed
        assert "\ndefault   Fmax = 15 N*m" in printed


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"\x89HDF\r\n\x1a\n", "a NetCDF or HDF5 file"),
        (b"CDF\x01\xff", "a NetCDF file"),
        ('name = "a"'.encode("utf-16"), "a text in UTF-16"),
        (b"\xff\x00", "no text"),
    ],
)
def test_a_file_that_is_no_text(folder, content, kind):
    (folder / "other").write_bytes(content)
    ended = typed("show", "other")
    assert (ended.code, ended.stdout) == (2, "")
    assert ended.stderr == f"fic-sweep: other: is {kind}; a sweep file is TOML, a text in UTF-8\n"


@pytest.mark.parametrize("arguments", [("show",), ("resume", "tiny.zarr", "--extend")])
def test_a_store_is_no_sweep_file(ran, arguments):
    ended = typed(*arguments, "tiny.zarr")
    assert ended.code == 2
    line = "fic-sweep: tiny.zarr: is a result store, no sweep file; `fic-sweep status tiny.zarr` "
    assert ended.stderr == line + "describes it\n"


def test_a_dry_run_that_run_would_refuse_is_refused_after_the_plan(folder):
    axes = "K0 = { log = [1, 9], n = 1000000 }\nKenv = { log = [1, 9], n = 99999 }"
    (folder / "big.toml").write_text(f'name = "big"\n[axes]\n{axes}')
    ended = typed("run", "big.toml", "--dry-run")
    assert ended.code == 2
    assert "= 99,999,000,000 scenarios" in ended.stdout and " on disk" in ended.stdout
    assert re.search(r"big\.zarr: the sweep needs up to [\d.e+]+ GB .* GB free\n", ended.stderr)
    assert not list(folder.glob("*.zarr"))


def test_a_store_is_not_made_in_a_store(ran, monkeypatch):
    monkeypatch.chdir(ran / "tiny.zarr")
    ended = typed("run", "../tiny.toml")
    assert ended.code == 2
    assert "tiny.zarr: lies in the store " in ended.stderr
    assert len(ended.stderr.splitlines()) == 1


def test_status_tells_neighbours_apart(folder):
    """Five places of an axis, all of which are 1000 in six digits."""
    axis = SpacedRange(lin=(1000.0, 1000.001), n=5)
    text = (folder / "tiny.toml").read_text()
    axes = (
        text.partition("[axes]")[0]
        + '[model]\ncontact = "welded"\n[axes]\nK0 = { lin = [1000.0, 1000.001], n = 5 }\n'
    )
    (folder / "tiny.toml").write_text(axes + "Kenv = [1e9]\n")
    call("run", "tiny.toml", code=0, folder=folder)
    status = call("status", "tiny.zarr", code=0, folder=folder).stdout
    found = re.findall(r"^diverged  K0 ([\d.]+), Kenv 1e\+09$", status, re.MULTILINE)
    assert found == [f"{value:.8g}" for value in axis.values()]
