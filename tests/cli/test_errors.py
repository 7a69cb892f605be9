"""A wrong request gets one clear line on stderr and exit code 2, and changes no file."""

import os
import re

import pytest

from tests.command import call, typed

WRONG = [
    (["run", "none"], "none: is no file and no sweep of the library; known are atlas"),
    (["run", "paper-weldd"], "did you mean `paper-welded`?"),
    (["run", "none.toml"], "none.toml: there is no such file"),
    (["run", "tiny.toml", "--set", "K=3"], "--set K=3: unknown key `K`"),
    (["run", "tiny.toml", "--set", "K0=1", "--set", "K0=2"], "--set K0=2: `K0` must be set once"),
    (
        ["run", "tiny.toml", "--set", "Td=0"],
        "tiny.toml with --set: `constants.Td` must be non-zero",
    ),
    (["run", "tiny.toml", "--precision", "16"], "'16' is not one of '32', '64'"),
    (["run", "tiny.toml", "--chunk", "0"], "--chunk"),
    (["run", "tiny.toml", "--out", "tiny.toml/a.zarr"], "tiny.toml/a.zarr: can't be written"),
    (["run", "tiny.toml", "--out", "/proc/a.zarr"], "for 12 cells, but /proc has 0 GB free"),
    (["run", "tiny.toml", "--frobnicate"], "No such option"),
    (["run", "tiny.toml", "--device", "tpu"], "'tpu' is not one of 'cpu', 'gpu'"),
    (["run", "tiny.toml", "--set", "error_estimate=1"], "must be true or false, but is 1."),
    (["run", "tiny.toml", "--set", "precision=16"], "`precision` must be 32 or 64, but is 16."),
    (["run", "tiny.toml", "--set", "precision=double"], 'must be 32 or 64, but is "double".'),
    (["run", "none.zarr"], "none.zarr: is no result store: there is nothing of this name"),
    (["run"], "Missing argument"),
    (["run", "tiny.toml", "--out", "x" * 300], "xxx: File name too long"),
    (["status", "x" * 300], "xxx: can't be read: File name too long"),
    (["run", "tiny.toml", "--out", "a", "--out", "b"], "--out takes one value, but is given 2"),
    (["run", "tiny.toml", "--set", "Td=5", "K0=3"], "argument K0=3; write --set K0=3 for one more"),
    (["report", "--only", "c12", "c99"], "unexpected argument c99; write --only c99 for one more"),
    (["report", "--only", "c12, c99"], "--only c99: is no claim; there are C1, "),
    (["status", "a.zarr", "b.zarr"], "unexpected argument b.zarr"),
    (["dance"], "No such command 'dance'"),
    (["resume", "tiny.zarr"], "tiny.zarr: is no result store"),
    (["status", "tiny.toml"], "tiny.toml: is no result store"),
    (["plot", "tiny.zarr", "--x", "K0", "--y", "Td"], "tiny.zarr: is no result store"),
    (["export", "tiny.zarr", "--to", "xls"], "'xls' is not one of 'csv', 'parquet', 'netcdf'"),
    (["bench", "--json", "--markdown"], "--json and --markdown: one of them"),
]
PLOT = ["plot", "tiny.zarr", "--x", "Td", "--y", "K0"]
WRONG_WITH_STORE = [
    (["run", "tiny.toml"], "tiny.zarr: exists already; `fic-sweep resume tiny.zarr` continues it"),
    ([*PLOT, "--out", "a.xyz"], "a picture ends in .png, .pdf, .svg, not in '.xyz'"),
    ([*PLOT, "--out", "none/a.png"], "none/a.png: can't be written: "),
    ([*PLOT[:3], "Kenv", *PLOT[4:]], "tiny.zarr: 'Kenv' does not vary here: it is 100 N*m/rad."),
    ([*PLOT, "--at", "sigma"], "--at sigma: must be KEY=VALUE, as in --at Td=5"),
    (
        [*PLOT, "--at", "a=1", "--at", "a=2"],
        "--at a: is given twice, 1 and 2; `history` draws several",
    ),
    (
        [*PLOT, "--metric", "nmse_error"],
        "tiny.zarr: There is no 'nmse_error': the store has no error estimates; "
        "run its sweep with --error-estimate.\n",
    ),
]


def name_of(arguments):
    return " ".join(arguments)[:40]


def refused(arguments, message):
    ended = typed(*arguments)
    assert ended.code == 2
    assert message in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert ended.stderr.startswith("fic-sweep: ")
    assert ended.stdout == ""


@pytest.mark.parametrize(("arguments", "message"), WRONG, ids=name_of)
def test_a_wrong_request_is_refused(folder, arguments, message):
    refused(arguments, message)
    assert [p.name for p in folder.iterdir()] == ["tiny.toml"]


@pytest.mark.parametrize(("arguments", "message"), WRONG_WITH_STORE, ids=name_of)
def test_a_wrong_request_for_a_store_is_refused(ran, arguments, message):
    before = {p: p.stat().st_mtime_ns for p in ran.rglob("*")}
    refused(arguments, message)
    assert {p: p.stat().st_mtime_ns for p in ran.rglob("*")} == before


def test_a_missing_gpu_is_refused(folder):
    """Also on a machine with a GPU: JAX is limited to the CPU, and the line says so."""
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    ended = call(
        "run", "tiny.toml", "--device", "gpu", code=2, folder=folder, environment=environment
    )
    assert re.search("JAX_PLATFORMS=cpu: JAX .* finds no gpu here; unset the var", ended.stderr)
    assert len(ended.stderr.splitlines()) == 1
