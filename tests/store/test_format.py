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
    assert data.attrs["error_estimate"] == 0
    assert data.attrs["metrics_definition"] == "motion"
    assert "integrals" in data.attrs["metrics_definition_meaning"]


def test_error_estimates_are_described(tmp_path):
    plan = parse(DRAWN, "f", ("error_estimate=true",))
    with xr.open_zarr(runner.start(tmp_path / "a.zarr", plan, None, 32).path) as data:
        assert data["nmse_error"].attrs == {
            "units": "1",
            "long_name": f"estimated error of {fic_jax.METRICS['nmse']['meaning']}",
        }
        assert data["nmse_trusted"].dtype == np.uint8
        assert data["nmse_trusted"].attrs == {
            "long_name": "whether the estimated error of nmse is at most 1 % of its value, "
            "or 1e-12",
            "bound": "max(1 % of nmse, 1e-12)",
            "flag_values": [0, 1, 2],
            "flag_meanings": "no_estimate not_trusted trusted",
        }
        assert data.attrs["error_estimate"] == 1
        assert "trusted" not in data
        assert "half the plant step" in data.attrs["error_estimate_meaning"]
        assert "error_estimate" not in data.attrs["sweep"]  # older programs would refuse it
        error, metric = data["nmse_error"].encoding, data["nmse"].encoding
        for key in ("dtype", "chunks", "compressors"):
            assert error[key] == metric[key]


@pytest.mark.parametrize("name", store_format.STORED)
def test_each_bound_is_named_in_words_and_as_a_formula(name):
    """Both say what TRUST has, in the unit and on the scale of the metric."""
    bound = fic_jax.TRUST[name]
    scale, words = {
        "value": (name, "its value"),
        "T_n": ("T_n", "the reachable torque"),
        "t_end": ("t_end", "the run's time"),
    }[bound.scale]
    floor = {"nmse": "1e-12", "nmse_tail": "1e-12", "energy_in": "1e-06 J"}.get(name)
    part = f"{100 * bound.part:g} % of"
    described = store_format.variable(Grid(PLAN), f"{name}_trusted", "float32")["attributes"]
    formula = f"{part} {scale}"
    assert described["bound"] == (f"max({formula}, {floor})" if floor else formula)
    whole = f"estimated error of {name} is at most {part} {words}" + (
        f", or {floor}" if floor else ""
    )
    assert described["long_name"].endswith(whole)


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
