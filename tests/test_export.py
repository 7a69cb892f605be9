import json
import sys

import numpy as np
import pandas as pd
import xarray as xr

from sweeps import runner
from sweeps.export import tables, write
from sweeps.spec.reading import parse
from sweeps.store.opening import dataset

PLAN = """
name = "estimated"
metrics = ["nmse", "peak_torque"]
error_estimate = true
time.t_end = 0.2
model.contact = "welded"
[axes]
K0 = { log = [1.0, 300.0], n = 5 }
Kenv = [100.0, 3000.0, 1e9]
[cases]
Denv = [0.0, 63.2]
"""


def test_exports_carry_estimates_in_order(tmp_path):
    store = runner.start(tmp_path / "a.zarr", parse(PLAN, "f"), None, 32)
    runner.run(store, lambda progress: None)
    (table,) = tables(dataset(store.path))
    names = "K0 Kenv case Denv nmse peak_torque nmse_error peak_torque_error"
    flags = ["nmse_trusted", "peak_torque_trusted"]
    assert list(table.columns) == [*names.split(), *flags, "status"]
    assert set(table["nmse_trusted"]) == {"no estimate", "not trusted", "trusted"}
    for flag in flags:
        assert set(table["status"][table[flag] == "no estimate"]) == {"diverged"}
    write(dataset(store.path), tmp_path / "a.nc", "netcdf")
    with xr.open_dataset(tmp_path / "a.nc") as copy, xr.open_zarr(store.path) as data:
        for flag in flags:
            np.testing.assert_array_equal(copy[flag], data[flag])
            assert copy[flag].attrs["bound"] == data[flag].attrs["bound"]
        assert copy.attrs["metrics_definition"] == "motion"
        np.testing.assert_array_equal(copy["nmse_error"], data["nmse_error"])
    write(dataset(store.path), tmp_path / "a.parquet", "parquet")
    copy = pd.read_parquet(tmp_path / "a.parquet")
    pd.testing.assert_frame_equal(copy, table)
    assert copy.attrs["metrics_definition"] == "motion"


def test_no_table_lacks_its_units_and_constants(tmp_path):
    """What was held at which value, defaults among it, and the unit of each column."""
    plan = parse(PLAN + "[constants]\nTd = 4.0", "f")
    store = runner.start(tmp_path / "a.zarr", plan, None, 32)
    runner.run(store, lambda progress: None)
    for to in ("csv", "parquet", "netcdf"):
        write(dataset(store.path), tmp_path / f"a.{to}", to)
    parquet = pd.read_parquet(tmp_path / "a.parquet")
    with xr.open_dataset(tmp_path / "a.netcdf") as netcdf, xr.open_zarr(store.path) as zarr:
        said = [frame.attrs["held"] for frame in (parquet, netcdf, zarr)]
        by_default = [frame.attrs["held_by_default"] for frame in (parquet, netcdf, zarr)]
    csv = json.loads((tmp_path / "a.csv-metadata.json").read_text())
    (note,) = csv["notes"]
    for held in (*map(json.loads, said), note["held"]):
        assert (held["Td"], held["Fmax"], held["I"], held["period"]) == (4.0, 15.0, 10.0, 0.01)
        assert (held["dt"], held["t_end"]) == (0.01, 0.2)
        assert (held["contact"], held["law"]) == ("welded", "algorithm1")
        assert not {"K0", "Kenv", "Denv"} & set(held)
    for names in (*by_default, note["held_by_default"]):
        assert "Fmax" in names.split() and "law" in names.split()
        assert not {"Td", "contact", "K0"} & set(names.split())
    units = {column["name"]: column["schema:unitText"] for column in csv["tableSchema"]["columns"]}
    assert list(units) == pd.read_csv(tmp_path / "a.csv").columns.tolist()
    assert (units["K0"], units["peak_torque"], units["nmse"]) == ("N*m/rad", "N*m", "1")
    assert parquet.attrs["units"].items() >= {"K0": "N*m/rad", "peak_torque": "N*m"}.items()


def test_a_csv_has_the_same_numbers_with_and_without_pyarrow(tmp_path, monkeypatch):
    store = runner.start(tmp_path / "a.zarr", parse(PLAN, "f"), None, 32)
    runner.run(store, lambda progress: None)
    data = dataset(store.path)
    write(data, tmp_path / "fast.csv", "csv")
    monkeypatch.setitem(sys.modules, "pyarrow.csv", None)
    write(data, tmp_path / "slow.csv", "csv")
    fast, slow = (pd.read_csv(tmp_path / name) for name in ("fast.csv", "slow.csv"))
    pd.testing.assert_frame_equal(fast, slow, check_exact=True, check_dtype=False)  # 100, 100.0
    (table,) = tables(data)
    np.testing.assert_array_equal(fast["nmse"].astype(np.float32), table["nmse"])
