"""Blocks cover a sweep's cells once, and a block's scenarios are those of its cells."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fic_jax import Model, Params
from sweeps.cli.messages import plan_lines
from sweeps.plan.grid import MAX_BLOCK, MAX_BLOCKS, Grid
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import parse
from tests.effort import lines_executed

EVERYTHING = """
name = "a"
[model]
law = "effort"
contact = ["welded", "hard_stop"]
[constants]
Fmax = 12.5
[cases]
Denv = [0.0, 63.2]
gap = [0.0, 0.1]
[axes]
Td = [1.0, 5.0, 20.0]
K0 = { log = [1.0, 100.0], n = 4 }
"""


def test_dimensions_are_model_lists_axes_and_cases_in_this_order():
    grid = Grid(parse(EVERYTHING, "f"))
    assert list(grid.dims.items()) == [("contact", 2), ("Td", 3), ("K0", 4), ("case", 2)]
    drawn = (
        'name = "a"\n[sample]\nn = 9\nranges = { Td = { lin = [1, 2] } }\n[cases]\nI = [1.0, 2.0]'
    )
    assert list(Grid(parse(drawn, "f")).dims.items()) == [("case", 2), ("scenario", 9)]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_block_has_the_values_of_its_cells_and_the_sweeps_constants(dtype):
    grid = Grid(parse(EVERYTHING, "f"))
    block = (slice(1, 2), slice(1, 3), slice(0, 1), slice(0, 2))
    params = grid.params(block, dtype)
    assert grid.model(block) == Model(contact="hard_stop", law="effort")
    swept = {"K0": [1.0] * 4, "Td": [5.0, 5.0, 20.0, 20.0], "Denv": [0.0, 63.2] * 2}
    expected = vars(Params()) | {"Fmax": 12.5} | swept | {"gap": [0.0, 0.1] * 2}
    for name, value in vars(params).items():
        assert value.dtype == dtype
        np.testing.assert_array_equal(value, np.asarray(expected[name], dtype), name)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    sides=st.lists(st.integers(2, 9), min_size=1, max_size=4),
    cases=st.integers(0, 4),
    chunk=st.integers(1, 200),
)
def test_blocks_cover_every_cell_once_with_its_own_values(sides, cases, chunk):
    """Each block's columns are the slice of the full grid; blocks fit and don't overlap."""
    names = ["K0", "Kenv", "Denv", "Td"][: len(sides)]
    axes = "".join(
        f"{n} = {{ lin = [1, 7], n = {k} }}\n" for n, k in zip(names, sides, strict=True)
    )
    case = f"[cases]\ngap = {[0.1 * i for i in range(cases)]}\n" if cases else ""
    grid = Grid(
        parse(f'name = "a"\n[model]\ncontact = ["welded", "hard_stop"]\n[axes]\n{axes}{case}', "f"),
        chunk,
    )
    along = [np.linspace(1, 7, k) for k in sides] + ([0.1 * np.arange(cases)] if cases else [])
    full = np.meshgrid(*along, indexing="ij")
    seen = np.zeros(grid.shape, int)
    for block in grid.blocks():
        seen[block] += 1
        params = grid.params(block)
        assert isinstance(params, Params)
        expected = [values[block[1:]].ravel() for values in full]
        for name, values in zip([*names, *(["gap"] if cases else [])], expected, strict=True):
            np.testing.assert_allclose(getattr(params, name), values, rtol=1e-15)
            assert len(values) <= max(chunk, 1)
        assert grid.model(block).contact == ["welded", "hard_stop"][block[0].start]
    assert (seen == 1).all()
    assert len(list(grid.blocks())) == grid.n_blocks


@pytest.mark.parametrize("estimate", ["false", "true"])
def test_a_block_takes_about_300_million_plant_steps(estimate):
    axes = "[axes]\nK0 = { lin = [1, 9], n = 1000 }\nKenv = { lin = [1, 9], n = 1000 }"
    grid = Grid(parse(f'name = "a"\nerror_estimate = {estimate}\n{axes}', "f"))
    runs = 6 if estimate == "true" else 1  # the second run halves the step and locates switches
    assert grid.block_cells == 300_000 // runs
    assert grid.block_cells / 4 < np.prod(grid.block_shape) <= grid.block_cells


AXES = 'name = "a"\n[axes]\n'


@pytest.mark.parametrize("n", [(1000, 1000, 100, 100), (1000,) * 4])
def test_a_huge_sweep_is_planned_in_little_memory_and_work(n):
    """10^10 cells, and the 10^12 that a sweep may have."""
    fields = zip(("K0", "Kenv", "Denv", "Td"), n, strict=True)
    axes = "".join(f"{name} = {{ log = [1.0, 1000.0], n = {k} }}\n" for name, k in fields)

    def plan():
        grid = Grid(parse(AXES + axes, "f"))
        return grid, plan_lines(grid, "float32")[0]

    tracemalloc.start()
    try:
        lines, (grid, told) = lines_executed(plan)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert f"= {np.prod(n):,} scenarios" in told
    assert grid.n_blocks <= MAX_BLOCKS
    assert lines < 50_000  # the file has 200 letters
    assert peak < 2_000_000  # bytes


@pytest.mark.parametrize("chunk", [0, -5, 2.5, True, "a"])
def test_a_chunk_that_is_no_number_of_cells_is_refused(chunk):
    with pytest.raises(SweepError, match="chunk must be a whole number of cells, 1 or more, not"):
        Grid(parse(EVERYTHING, "f"), chunk)


def test_a_chunk_that_makes_too_many_or_too_large_blocks_is_refused():
    sweep = parse(AXES + "K0 = { lin = [1, 9], n = 10000000 }\nTd = [1.0, 2.0]", "f")
    with pytest.raises(SweepError, match=f"at most {MAX_BLOCK:,} cells in a block, not 20,000,000"):
        Grid(sweep, 10**12)
    with pytest.raises(SweepError, match=f"at most {MAX_BLOCKS:,} blocks, not 3,"):
        Grid(sweep, 9)
    assert Grid(sweep, MAX_BLOCK).n_blocks == 2
