"""What each command writes and prints."""

import re
import shutil

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import fic_jax
from sweeps import runner
from sweeps.paper import claims
from tests.command import call, typed


def test_version():
    assert typed("--version").stdout == f"fic-sweep {fic_jax.__version__}\n"


def test_list_names_the_sweeps_of_the_library():
    listed = typed("list")
    assert listed.code == 0
    for name in ("paper-welded", "paper-contact", "paper-stiffness", "paper-damping"):
        assert re.search(rf"^{name} +[\d,]+  \w", listed.stdout, re.MULTILINE)


def test_show_prints_the_file_and_its_size():
    shown = typed("show", "atlas").stdout
    assert "= 10,378,500 scenarios of 1,000 steps" in shown
    assert 'contact = "hard_stop"' in shown


def test_a_file_hides_a_library_sweep_of_the_same_name(folder):
    (folder / "atlas").write_text((folder / "tiny.toml").read_text())
    assert "= 12 scenarios of 50 steps" in typed("show", "atlas").stdout


def test_run_writes_a_store_and_prints_one_line(first_run):
    path, done = first_run
    assert re.fullmatch(r"tiny\.zarr: 12 scenarios in [\d.]+ s\n", done.stdout)
    with xr.open_zarr(path / "tiny.zarr") as data:
        assert data.sizes == {"K0": 4, "Td": 3}
        assert data["nmse"].dtype == np.float32
        assert np.isfinite(data["nmse"]).all()


def test_status_counts_cells_and_blocks(ran):
    status = typed("status", "tiny.zarr").stdout
    assert "12 of 12 cells (100 %)" in status
    assert "blocks    0 of 1 to do" in status
    assert re.search(r"ended 20\d\d-", status)
    assert "trusted" not in status


def test_verify_finds_a_changed_file_and_repairs_it(ran, folder):
    shutil.copytree(ran / "tiny.zarr", folder / "tiny.zarr")
    good = typed("verify", "tiny.zarr")
    assert re.fullmatch(r"tiny\.zarr: 1 block, \d+ files: all as written\n", good.stdout)
    (chunk,) = (folder / "tiny.zarr" / "nmse").glob("c.*")
    written = chunk.read_bytes()
    chunk.write_bytes(written[:-1] + bytes([written[-1] ^ 1]))
    bad = typed("verify", "tiny.zarr")
    assert bad.code == 1
    assert f"1 not as written\n  nmse/{chunk.name} " in bad.stdout
    repaired = typed("verify", "tiny.zarr", "--repair")
    assert repaired.code == 0
    assert "tiny.zarr: computing 1 block again\n" in repaired.stdout
    assert repaired.stdout.endswith("all as written\n")
    assert chunk.read_bytes() == written


def test_resume_of_a_finished_store_runs_nothing(ran):
    assert typed("resume", "tiny.zarr").stdout == "tiny.zarr: complete already, 12 scenarios\n"


def test_set_changes_a_value_and_makes_an_axis(folder):
    done = call(
        "run", "tiny.toml", "--set", "Td=5", "--set", "sigma=[0.01, 0.02]",
        "--set", "law=effort", "--precision", "64", "--out", "sub/other.zarr",
        code=0, folder=folder,
    )  # fmt: skip
    assert "sub/other.zarr: 8 scenarios in" in done.stdout
    with xr.open_zarr(folder / "sub" / "other.zarr") as data:
        assert dict(data.sizes) == {"K0": 4, "sigma": 2}
        assert data["nmse"].dtype == np.float64


def test_dry_run_prints_size_and_time_and_writes_nothing(folder):
    done = typed("run", "tiny.toml", "--dry-run", "--set", "K0=[200, 300]")
    assert "K0 2 x Td 3 = 6 scenarios of 50 steps" in done.stdout
    assert "286 B on disk before compression" in done.stdout
    assert re.search(r"about [\d.]+ s at [\d,]+ scenarios/s", done.stdout)
    assert "warning: tiny: K0*x0 reaches 2 times Fmax" in done.stderr
    assert done.code == 0
    assert [p.name for p in folder.iterdir()] == ["tiny.toml"]


def test_error_estimate_stores_errors_and_counts_trusted_cells(folder):
    done = typed("run", "tiny.toml", "--error-estimate")
    shares = r"^trusted   nmse [\d.]+ %, nmse_tail [\d.]+ %, "
    assert re.search(shares, done.stdout, re.MULTILINE)
    status = typed("status", "tiny.zarr").stdout
    assert re.search(shares, status, re.MULTILINE)
    assert "metrics   integrals and extremes of the motion\n" in status
    assert max(map(len, status.splitlines())) <= 100
    with xr.open_zarr(folder / "tiny.zarr") as data:
        assert np.isfinite(data["nmse_error"]).all()


def test_precision_is_that_of_the_command_or_the_file(folder, monkeypatch):
    """A store records it as its dtype; `run` sets JAX up for it."""
    with (folder / "tiny.toml").open("r+") as file:
        text = file.read()
        file.seek(0)
        file.write("precision = 64\n" + text)
    assert "before compression, float64" in typed("show", "tiny.toml").stdout
    configured = []
    monkeypatch.setattr(runner, "start", lambda *args: configured.append(args[-1]) or 1 / 0)
    for more, bits in (
        ((), 64),
        (("--precision", "32"), 32),
        (("--set", "precision=32"), 32),
        (("--set", "precision=32", "--precision", "64"), 64),
    ):
        with pytest.raises(ZeroDivisionError):
            typed("run", "tiny.toml", *more)
        assert configured.pop() == bits
        planned = typed("run", "tiny.toml", "--dry-run", *more).stdout
        assert f"before compression, float{bits}" in planned


def test_expectation_is_a_dimension_like_any_choice(folder):
    done = typed("run", "tiny.toml", "--set", 'expectation=["displacement", "error"]')
    assert done.code == 0
    with xr.open_zarr(folder / "tiny.zarr") as data:
        assert dict(data.sizes) == {"expectation": 2, "K0": 4, "Td": 3}
        assert data["expectation"].values.tolist() == ["displacement", "error"]
    options = ("--x", "Td", "--y", "K0", "--at", "expectation=error")
    assert typed("plot", "tiny.zarr", *options).code == 0


def test_export_writes_a_table_and_replaces_none(ran):
    with xr.open_zarr("tiny.zarr", chunks=None) as data:
        for to, read in (("csv", pd.read_csv), ("parquet", pd.read_parquet)):
            assert typed("export", "tiny.zarr", "--to", to).code == 0
            table = read(ran / f"tiny.{to}")
            assert len(table) == 12
            assert set(table["status"]) == {"ok"}
            row = table[(table["Td"] == 5.0) & np.isclose(table["K0"], 100.0)]
            np.testing.assert_allclose(row["nmse"], data["nmse"].sel(Td=5.0)[-1], rtol=1e-6)
        assert typed("export", "tiny.zarr", "--to", "netcdf").code == 0
        with xr.open_dataset(ran / "tiny.nc") as copy:
            np.testing.assert_array_equal(copy["nmse"], data["nmse"])
            np.testing.assert_array_equal(copy["status"], data["status"])
            assert copy["K0"].attrs["units"] == "N*m/rad"
    again = typed("export", "tiny.zarr", "--to", "csv")
    assert (again.code, "tiny.csv: exists already" in again.stderr) == (2, True)


def test_the_program_alone_prints_its_help():
    alone = typed()
    assert (alone.code, alone.stdout) == (2, "")
    assert alone.stderr.startswith("Usage: fic-sweep ")
    assert "\n  resume " in alone.stderr


def test_only_takes_several_claims_in_one_value(monkeypatch):
    chosen = []
    monkeypatch.setattr(claims, "chosen", lambda ids: chosen.append(ids) or 1 / 0)
    for only in (["c12,C13"], ["c12 , C13,"], ["c12", "--only", "C13"]):
        with pytest.raises(ZeroDivisionError):
            typed("report", "--only", *only)
        assert chosen.pop() == ["c12", "C13"]
