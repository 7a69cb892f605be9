"""A random design has the same scenarios in any blocks, evenly over its ranges."""

import numpy as np
import pytest

from sweeps.plan.grid import Grid
from sweeps.plan.random_design import draw
from sweeps.spec.reading import parse
from sweeps.spec.types import RandomDesign


@pytest.mark.parametrize("method", ["sobol", "lhs", "random"])
def test_any_part_of_a_design_has_the_values_of_the_whole(method):
    text = (
        f'name = "a"\n[sample]\nn = 1024\nmethod = "{method}"\nseed = 3\n'
        "ranges = { Td = { lin = [1.0, 5.0] }, K0 = { log = [1.0, 1000.0] } }"
    )
    grid = Grid(parse(text, "f"))
    whole = grid.coordinates("scenario")
    for start, stop in ((0, 1), (1, 6), (337, 411), (1000, 1024), (0, 5)):
        part = grid.coordinates("scenario", slice(start, stop))
        for name in ("Td", "K0"):
            np.testing.assert_array_equal(part[name], whole[name][start:stop])
    assert np.all((whole["Td"] >= 1.0) & (whole["Td"] <= 5.0))
    # mean 3, standard error 4/sqrt(12 n) = 0.036 for random draws, far less for the others
    assert np.mean(whole["Td"]) == pytest.approx(3.0, abs=0.12)
    assert np.mean(np.log10(whole["K0"])) == pytest.approx(1.5, abs=0.1)
    # fields are independent: correlation 0, standard error 1/sqrt(n) = 0.03
    assert abs(np.corrcoef(whole["Td"], np.log(whole["K0"]))[0, 1]) < 0.12
    if method == "lhs":
        strata = np.floor((whole["Td"] - 1.0) / 4.0 * 1024)
        assert len(np.unique(strata)) == 1024


@pytest.mark.parametrize("method", ["sobol", "lhs", "random"])
def test_another_seed_draws_another_design(method):
    one, same, other = (
        draw(RandomDesign(n=64, method=method, seed=seed, ranges={"Td": {"lin": (1, 5)}}), 0, 64)
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one["Td"], same["Td"])
    assert np.all(one["Td"] != other["Td"])
