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
