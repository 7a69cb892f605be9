import numpy as np
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
    names = "K0 Kenv case Denv nmse peak_torque nmse_error peak_torque_error trusted status"
    assert list(table.columns) == names.split()
    assert set(table["trusted"]) == {"no estimate", "not trusted", "trusted"}
    assert set(table["status"][table["trusted"] == "no estimate"]) == {"diverged"}
    write(dataset(store.path), tmp_path / "a.nc", "netcdf")
    with xr.open_dataset(tmp_path / "a.nc") as copy, xr.open_zarr(store.path) as data:
        np.testing.assert_array_equal(copy["trusted"], data["trusted"])
        np.testing.assert_array_equal(copy["nmse_error"], data["nmse_error"])
