"""What `xarray.open_zarr` reads, and what it is called."""

import json
import warnings

import numpy as np
import pytest
import xarray as xr

import fic_jax
from sweeps import runner
from sweeps.plan.grid import Grid
from sweeps.spec.reading import parse
from sweeps.store import format as store_format
from tests.store.stores import flip

PLAN = parse(
    """
name = "tiny"
[model]
contact = ["welded", "hard_stop"]
[axes]
K0 = { log = [1.0, 300.0], n = 5 }
Td = [1.0, 5.0, 20.0]
[cases]
Denv = [0.0, 63.2]
gap = [0.0, 0.1]
""",
    "tiny.toml",
)
DRAWN = """
name = "drawn"
metrics = ["nmse"]
[model]
contact = ["welded", "hard_stop"]
[sample]
n = 10
ranges = { Td = { lin = [1.0, 5.0] }, K0 = { log = [1.0, 9.0] } }
"""


def test_xarray_opens_a_store_without_our_code_and_without_a_warning(tmp_path):
    path = runner.start(tmp_path / "tiny.zarr", PLAN, None, 32).path
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = xr.open_zarr(path)
    assert data["nmse"].dims == ("contact", "K0", "Td", "case")
    assert data.sizes == {"contact": 2, "K0": 5, "Td": 3, "case": 2}
    assert set(data.data_vars) == {*PLAN.metrics, "status"}
    assert data["K0"].attrs["units"] == "N*m/rad"
    assert data["convergence_time"].attrs == {
        "units": "s",
        "long_name": fic_jax.METRICS["convergence_time"]["meaning"],
    }
    np.testing.assert_array_equal(data["contact"], ["welded", "hard_stop"])
    np.testing.assert_array_equal(data["Denv"], [0.0, 63.2])
    assert data["Denv"].dims == ("case",)
    assert (data["status"] == store_format.NOT_RUN).all()
    assert np.isnan(data["nmse"]).all()
    for key in ("numerics", "arithmetic", "revision", "jax", "device", "dtype", "start", "sweep"):
        assert data.attrs[key], key
    assert json.loads(data.attrs["sweep"])["axes"]["Td"] == [1.0, 5.0, 20.0]
    assert (data.attrs["error_estimate"], "trust_bound" in data.attrs) == (0, False)


def test_error_estimates_are_described(tmp_path):
    plan = parse(DRAWN, "f", ("error_estimate=true",))
    with xr.open_zarr(runner.start(tmp_path / "a.zarr", plan, None, 32).path) as data:
        assert data["nmse_error"].attrs == {
            "units": "1",
            "long_name": f"estimated error of {fic_jax.METRICS['nmse']['meaning']}",
        }
        assert data["trusted"].dtype == np.uint8
        assert data["trusted"].attrs["flag_values"] == [0, 1, 2]
        assert data["trusted"].attrs["flag_meanings"] == "no_estimate not_trusted trusted"
        assert (data.attrs["error_estimate"], data.attrs["trust_bound"]) == (1, fic_jax.TRUST)
        assert "half the plant step" in data.attrs["error_estimate_meaning"]
        assert "error_estimate" not in data.attrs["sweep"]  # older programs would refuse it
        error, metric = data["nmse_error"].encoding, data["nmse"].encoding
        for key in ("dtype", "chunks", "compressors"):
            assert error[key] == metric[key]


@pytest.mark.parametrize(
    ("estimate", "expected"),
    [("false", 20 * (4 + 1) + 8 * (2 + 2 * 10)), ("true", 20 * (8 + 2) + 8 * (2 + 2 * 10))],
)
def test_size_counts_variables_and_coordinates(estimate, expected):
    plan = parse(DRAWN, "f", (f"error_estimate={estimate}",))
    assert store_format.size(Grid(plan), "float32") == expected


def test_a_long_coordinate_is_written_piece_by_piece(tmp_path, monkeypatch):
    """Each piece of the sample is drawn by itself; the last one is shorter."""
    plan = parse(DRAWN, "f")
    once = runner.start(tmp_path / "once.zarr", plan, None, 32).path
    monkeypatch.setattr(store_format, "COORDINATE_CHUNK", 4)
    pieces = runner.start(tmp_path / "pieces.zarr", plan, None, 32).path
    assert sorted(file.name for file in (pieces / "Td").glob("c.*")) == ["c.0", "c.1", "c.2"]
    with xr.open_zarr(once) as one, xr.open_zarr(pieces) as other:
        xr.testing.assert_identical(one.drop_attrs(), other.drop_attrs())


def test_a_flipped_bit_raises_instead_of_being_read(stores):
    """The CRC of the codec guards a reader who knows nothing of the ledger."""
    with stores.case("whole") as path:
        flip(path / "nmse" / "c.0", 8 * (path / "nmse" / "c.0").stat().st_size // 2)
        with pytest.raises(Exception, match="checksum"):
            xr.open_zarr(path, chunks=None)["nmse"].load()
