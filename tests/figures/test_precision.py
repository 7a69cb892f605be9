"""The difference between a sweep in single and in double precision."""

import numpy as np
import xarray as xr

from figures import precision


def store(nmse, status):
    dims = ("K0", "Kenv", "Td")
    coords = {"K0": [1.0, 30.0, 1000.0], "Kenv": [10.0, 20.0, 30.0, 40.0], "Td": [1.0, 5.0]}
    return xr.Dataset({"nmse": (dims, nmse), "status": (dims, status)}, coords=coords)


def test_the_difference_is_relative_and_only_of_scenarios_that_ran_in_both():
    shape = 3, 4, 2
    double = np.full(shape, 2.0)
    single = double * (1 + 1e-3 * np.arange(24).reshape(shape) / 24)
    status = np.ones(shape, np.uint8)
    diverged = status.copy()
    diverged[0, 0, 0] = 2
    apart = precision.difference(store(single, status), store(double, diverged))
    np.testing.assert_allclose(apart.values.ravel()[1:], 1e-3 * np.arange(1, 24) / 24)
    assert np.isnan(apart[0, 0, 0])
    lines = precision.table(apart).splitlines()
    assert lines[0] == "| beyond | all | K0 1 to 10 | K0 10 to 100 | K0 100 to 1000 |"
    # 0.0001 lies between the differences of the scenarios 2 and 3
    assert lines[3] == f"| 0.0001 | {100 * 21 / 23:.3g} % | {100 * 5 / 7:.3g} % | 100 % | 100 % |"
    half, most = precision.plot(apart).axes[:2]
    assert [axes.get_title().split("\n")[0] for axes in (half, most)] == list(precision.SHARES)
    drawn = precision.quantile(apart, "Kenv", "K0", 0.5)["difference"]
    np.testing.assert_allclose(drawn[2, 3], 1e-3 * 22.5 / 24)
