"""Where a command may write: no device, no store; a full disk is a failure, no wrong request."""

import os
import shutil
import subprocess
import sys

import pytest

from tests.command import typed

EXPORT = ("export", "tiny.zarr", "--to", "csv")
PLOT = ("plot", "tiny.zarr", "--x", "Td", "--y", "K0")


@pytest.fixture
def copied(ran, tmp_path, monkeypatch):
    """A folder with the sweep file and the finished store, in the working directory."""
    shutil.copytree(ran / "tiny.zarr", tmp_path / "tiny.zarr")  # and nothing that a test left
    shutil.copy(ran / "tiny.toml", tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", [EXPORT, PLOT])
def test_what_is_no_file_is_not_replaced(copied, command):
    """`--out /dev/full --force` replaced the device by a table."""
    os.mkfifo(copied / "pipe.png")
    (copied / "folder.png").mkdir()
    for name in ("pipe.png", "folder.png"):
        kind = os.lstat(copied / name).st_mode
        for force in ((), ("--force",)):
            ended = typed(*command, "--out", name, *force)
            assert ended.code == 2
            assert f"{name}: is no regular file; --out names another" in ended.stderr
        assert os.lstat(copied / name).st_mode == kind


@pytest.mark.parametrize("command", [EXPORT, PLOT])
@pytest.mark.parametrize("name", ["ledger.sqlite", "zarr.json", "nmse/c.0.0", "new.png"])
def test_nothing_is_written_into_a_store(copied, command, name):
    ended = typed(*command, "--out", f"tiny.zarr/{name}", "--force")
    assert ended.code == 2
    assert "lies in the store " in ended.stderr
    assert typed("verify", "tiny.zarr").code == 0


def test_an_export_says_how_much_was_not_run(copied):
    """Half of its rows are empty, and a table has no status of its own."""
    from sweeps.store.opening import open_store

    open_store(copied / "tiny.zarr").ledger.delete([0])
    shutil.rmtree(copied / "tiny.zarr" / "status" / "c.0.0", ignore_errors=True)
    for name in open_store(copied / "tiny.zarr").variables:
        (copied / "tiny.zarr" / name / "c.0.0").unlink()
    ended = typed(*EXPORT)
    assert ended.code == 0
    message = "warning: 12 of them were not run; `fic-sweep resume tiny.zarr` runs them"
    assert message in ended.stderr


@pytest.mark.parametrize("command", [("resume", "tiny.zarr"), ("status", "tiny.zarr")])
def test_a_lost_file_of_a_finished_block_is_named(copied, command):
    """`resume` said "complete already"."""
    (copied / "tiny.zarr" / "nmse" / "c.0.0").unlink()
    ended = typed(*command)
    assert ended.code == 2
    assert (
        "lacks nmse/c.0.0, of finished blocks; `fic-sweep verify tiny.zarr --repair` mends it"
        in (ended.stderr)
    )


SMALL_DISK = """
import resource, sys
from sweeps.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
sys.argv = ["fic-sweep", *sys.argv[1:]]
main()
"""


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (("run", "tiny.toml", "--out", "full.zarr"), "full.zarr"),
        (("export", "tiny.zarr", "--to", "csv", "--out", "full.csv"), "full.csv"),
        (("export", "tiny.zarr", "--to", "parquet", "--out", "full.parquet"), "full.parquet"),
        (("export", "tiny.zarr", "--to", "netcdf", "--out", "full.nc"), "full.nc"),
        ((*PLOT, "--out", "full.png"), "full.png"),
    ],
)
def test_a_disk_that_refuses_is_a_failure_in_one_line(copied, command, name):
    done = subprocess.run(
        [sys.executable, "-c", SMALL_DISK, *command],
        capture_output=True,
        text=True,
        env=os.environ | {"FIC_SWEEP_CACHE": ""},
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr == f"fic-sweep: {name}: can't be written: File too large\n"
    assert not list(copied.glob("*full*"))
