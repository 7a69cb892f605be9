"""`fic-sweep` as a user types it: in an empty folder, in a process of its own."""

import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from tests.command import FIC_SWEEP, typed
from tests.command import call as called

TINY = """
name = "tiny"
[time]
t_end = 0.5
[axes]
K0 = { log = [1.0, 100.0], n = 4 }
Td = [1.0, 5.0, 20.0]
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    return tmp_path


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A folder in which tiny.toml has been run."""
    path = tmp_path_factory.mktemp("ran")
    (path / "tiny.toml").write_text(TINY)
    call(path, "run", "tiny.toml", code=0)
    return path


def call(folder, *arguments, code):
    return called(*arguments, code=code, folder=folder)


def test_help_names_every_command():
    done = call(".", "--help", code=0)
    for command in ("list", "show", "run", "resume", "status", "plot", "export", "bench"):
        assert re.search(rf"^  {command} ", done.stdout, re.MULTILINE)


END = """
import atexit, sys
from sweeps import cli

def dispatch():
    atexit.register(print, "cleaned up")
    print("done")
    if sys.argv[1:]:
        raise RuntimeError("a mistake of ours")
    return 2

cli._dispatch = dispatch
cli.main()
"""


@pytest.mark.parametrize(("wrong", "code", "told"), [([], 2, ""), (["wrong"], 1, "a mistake of")])
def test_a_process_ends_with_its_code_once_all_is_printed_and_cleaned_up(wrong, code, told):
    done = subprocess.run(
        [sys.executable, "-c", END, *wrong], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (code, "done\ncleaned up\n")
    assert told in done.stderr and bool(done.stderr) == bool(told)


def test_a_reader_who_has_gone_is_no_reason_for_a_traceback():
    buffered = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    with subprocess.Popen(
        [FIC_SWEEP, "--version"], env=buffered, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


def test_list_and_show(folder):
    listed = call(folder, "list", code=0).stdout
    for name in ("paper-welded", "paper-contact", "paper-stiffness", "paper-damping"):
        assert name in listed
    shown = call(folder, "show", "atlas", code=0).stdout
    assert "= 10,378,500 scenarios of 1,000 steps" in shown
    assert 'contact = "hard_stop"' in shown


def test_run_tells_what_it_did(ran):
    with xr.open_zarr(ran / "tiny.zarr") as data:
        assert data.sizes == {"K0": 4, "Td": 3}
        assert data["nmse"].dtype == np.float32
        assert np.isfinite(data["nmse"]).all()
    told = call(ran, "status", "tiny.zarr", code=0).stdout
    assert "12 of 12 cells (100 %)" in told
    assert re.search(r"ended 20\d\d-", told)
    again = call(ran, "resume", "tiny.zarr", code=0)
    assert "complete already" in again.stdout


def test_set_changes_a_value_and_makes_an_axis(folder):
    done = call(
        folder, "run", "tiny.toml", "--set", "Td=5", "--set", "sigma=[0.01, 0.02]",
        "--set", "law=effort", "--precision", "64", "--out", "sub/other.zarr", code=0,
    )  # fmt: skip
    assert "sub/other.zarr: 8 scenarios in" in done.stdout
    with xr.open_zarr(folder / "sub" / "other.zarr") as data:
        assert dict(data.sizes) == {"K0": 4, "sigma": 2}
        assert data["nmse"].dtype == np.float64


def test_dry_run_writes_nothing(folder):
    told = call(folder, "run", "tiny.toml", "--dry-run", code=0).stdout
    assert "K0 4 x Td 3 = 12 scenarios of 50 steps" in told
    assert "548 B on disk before compression" in told
    assert re.search(r"about [\d.]+ s at [\d,]+ scenarios/s", told)
    assert [p.name for p in folder.iterdir()] == ["tiny.toml"]


WRONG = [
    (["run", "none"], "none: is no file and no sweep of the library; there are atlas"),
    (["run", "paper-weldd"], "did you mean `paper-welded`?"),
    (["run", "none.toml"], "none.toml: there is no such file"),
    (["run", "tiny.toml", "--set", "K=3"], "--set K=3: unknown key `K`"),
    (["run", "tiny.toml", "--set", "Td=0"], "tiny.toml: `constants.Td` must be non-zero"),
    (["run", "tiny.toml", "--precision", "16"], "'16' is not one of '32', '64'"),
    (["run", "tiny.toml", "--chunk", "0"], "--chunk"),
    (["run", "tiny.toml", "--out", "tiny.toml/a.zarr"], "tiny.toml/a.zarr: can't be written"),
    (["run", "tiny.toml", "--out", "/proc/a.zarr"], "for 12 cells, but /proc has 0 GB free"),
    (["run", "tiny.toml", "--frobnicate"], "No such option"),
    (["run", "tiny.toml", "--device", "tpu"], "'tpu' is not one of 'cpu', 'gpu'"),
    (["run", "tiny.toml", "--set", "error_estimate=1"], "must be true or false, but is 1."),
    (["run"], "Missing argument"),
    (["run", "tiny.toml", "--out", "x" * 300], "xxx: File name too long"),
    (["status", "x" * 300], "xxx: is no result store"),
    (["dance"], "No such command 'dance'"),
    (["resume", "tiny.zarr"], "tiny.zarr: is no result store"),
    (["status", "tiny.toml"], "tiny.toml: is no result store"),
    (["plot", "tiny.zarr", "--x", "K0", "--y", "Td"], "tiny.zarr: is no result store"),
    (["export", "tiny.zarr", "--to", "xls"], "'xls' is not one of 'csv', 'parquet', 'netcdf'"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG, ids=lambda a: " ".join(a)[:40])
def test_wrong_request_gets_one_line_and_exit_2(folder, arguments, message, monkeypatch):
    monkeypatch.chdir(folder)
    done = typed(*arguments)
    assert done.code == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("fic-sweep: ")
    assert [p.name for p in folder.iterdir()] == ["tiny.toml"]


def test_a_gpu_that_is_not_there_is_told(folder):
    done = call(folder, "run", "tiny.toml", "--device", "gpu", code=2)
    assert "finds no gpu here; a GPU needs a driver" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_existing_store_is_refused(ran):
    done = call(ran, "run", "tiny.toml", code=2)
    assert "tiny.zarr: exists already; `fic-sweep resume tiny.zarr` continues it" in done.stderr


def test_warnings_go_on(folder):
    done = call(folder, "run", "tiny.toml", "--set", "K0=[200, 300]", "--dry-run", code=0)
    assert "warning: tiny: K0*x0 reaches 2 times Fmax" in done.stderr


@pytest.mark.parametrize(
    ("how", "seen"), [(signal.SIGINT, "zarr.json"), (signal.SIGTERM, "status/c.*")]
)
def test_interrupt_keeps_blocks_and_resume_ends_with_the_same_bits(folder, how, seen):
    """Thirty blocks; stopped while XLA compiles, or once the first block has been committed."""
    sweep = ["run", "tiny.toml", "--set", "K0={log=[1, 100], n=300}", "--set", "t_end=200"]
    sweep += ["--chunk", "30"]
    running = subprocess.Popen(
        [FIC_SWEEP, *sweep],
        cwd=folder,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while not list((folder / "tiny.zarr").glob(seen)) and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(running.pid, how)
    _, told = running.communicate(timeout=60)
    assert running.returncode == 1, told
    last = told.splitlines()[-1]
    kept = re.search(
        r"interrupted; (\d+) of 30 blocks are kept, `fic-sweep resume tiny.zarr` does the rest",
        last,
    )
    assert kept, told
    assert "Traceback" not in told
    assert (0 if seen == "zarr.json" else 1) <= int(kept[1]) < 30
    resumed = call(folder, "resume", "tiny.zarr", code=0).stdout
    assert f"tiny.zarr: {900 - 30 * int(kept[1])} scenarios in" in resumed
    call(folder, *sweep, "--out", "undisturbed.zarr", code=0)
    with (
        xr.open_zarr(folder / "tiny.zarr") as one,
        xr.open_zarr(folder / "undisturbed.zarr") as two,
    ):
        xr.testing.assert_equal(one, two)


def test_plot(ran):
    call(ran, "plot", "tiny.zarr", "--x", "Td", "--y", "K0", "--metric", "nmse_tail", code=0)
    assert (ran / "tiny-nmse_tail.png").read_bytes().startswith(b"\x89PNG")
    call(ran, "plot", "tiny.zarr", "--x", "Td", "--y", "K0", "--out", "a.pdf", code=0)
    assert (ran / "a.pdf").read_bytes().startswith(b"%PDF")
    wrong = call(ran, "plot", "tiny.zarr", "--x", "Td", "--y", "K0", "--out", "a.xyz", code=2)
    assert "a picture ends in .png, .pdf, .svg, not in '.xyz'" in wrong.stderr
    wrong = call(ran, "plot", "tiny.zarr", "--x", "Kenv", "--y", "K0", code=2)
    assert "tiny.zarr: There is no dimension 'Kenv'. " in wrong.stderr
    wrong = call(ran, "plot", "tiny.zarr", "--x", "Td", "--y", "K0", "--at", "sigma", code=2)
    assert "--at sigma: must be KEY=VALUE, as in --at Td=5" in wrong.stderr


def test_error_estimate(folder):
    done = call(folder, "run", "tiny.toml", "--error-estimate", code=0)
    assert re.search(r"; trusted \d+ of 12 cells \([\d.]+ %\), nmse known to 1 %\n$", done.stdout)
    told = call(folder, "status", "tiny.zarr", code=0).stdout
    assert re.search(r"^trusted   \d+ of 12 cells \([\d.]+ %\), nmse known to 1 %$", told, re.M)
    with xr.open_zarr(folder / "tiny.zarr") as data:
        assert np.isfinite(data["nmse_error"]).all()


def test_an_error_nobody_estimated_is_refused(ran):
    wrong = call(
        ran, "plot", "tiny.zarr", "--x", "Td", "--y", "K0", "--metric", "nmse_error", code=2
    )
    assert wrong.stderr == (
        "fic-sweep: tiny.zarr: There is no 'nmse_error': the store has no error estimates; "
        "`fic-sweep run --error-estimate` makes them.\n"
    )
    assert "trusted" not in call(ran, "status", "tiny.zarr", code=0).stdout


def test_export(ran):
    with xr.open_zarr(ran / "tiny.zarr", chunks=None) as data:
        for to, read in (("csv", pd.read_csv), ("parquet", pd.read_parquet)):
            call(ran, "export", "tiny.zarr", "--to", to, code=0)
            table = read(ran / f"tiny.{to}")
            assert len(table) == 12
            assert set(table["status"]) == {"ok"}
            row = table[(table["Td"] == 5.0) & np.isclose(table["K0"], 100.0)]
            np.testing.assert_allclose(row["nmse"], data["nmse"].sel(Td=5.0)[-1], rtol=1e-6)
        call(ran, "export", "tiny.zarr", "--to", "netcdf", code=0)
        with xr.open_dataset(ran / "tiny.nc") as copy:
            np.testing.assert_array_equal(copy["nmse"], data["nmse"])
            np.testing.assert_array_equal(copy["status"], data["status"])
            assert copy["K0"].attrs["units"] == "N*m/rad"
    again = call(ran, "export", "tiny.zarr", "--to", "csv", code=2)
    assert "tiny.csv: exists already" in again.stderr


def test_a_line_now_and_then_without_a_terminal(ran):
    """Nothing but the summary for a run that is over at once: no bar, no control codes."""
    done = call(ran, "run", "tiny.toml", "--out", "again.zarr", code=0)
    assert len(done.stdout.splitlines()) == 1
    assert "\x1b" not in done.stdout + done.stderr
