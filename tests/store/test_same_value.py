"""Values that two sweeps share, to rounding, are one place: an extension keeps its cells' bits."""

import numpy as np
import pytest

from sweeps import runner
from sweeps.spec.reading import parse
from sweeps.store import extend
from sweeps.store.opening import Counts, dataset, open_store

HEAD = 'name = "begun"\nmetrics = ["nmse"]\ntime.t_end = 0.1\n'
PAIRS = {  # name -> smaller and larger sweep, number of places that both have
    "logarithmic": ("axes.K0 = {log=[1.0, 100.0], n=9}", "axes.K0 = {log=[1.0, 1000.0], n=13}", 9),
    "three decades": ("axes.K0 = {log=[3.0, 300.0], n=7}", "axes.K0 = {log=[0.3, 3e3], n=13}", 7),
    "even": ("axes.gap = {lin=[0.0, 1.0], n=11}", "axes.gap = {lin=[0.0, 3.0], n=31}", 11),
    "falling": ("axes.gap = {lin=[1.0, 0.0], n=11}", "axes.gap = {lin=[0.0, 3.0], n=31}", 11),
    "through zero": ("axes.xd = {lin=[-0.1, 0.2], n=4}", "axes.xd = {lin=[-0.3, 0.2], n=6}", 4),
    "range to list": (
        "axes.gap = {lin=[0.1, 0.5], n=5}", "axes.gap = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]", 5),
    "list to range": ("axes.gap = [0.3, 0.7]", "axes.gap = {lin=[0.0, 1.0], n=11}", 2),
    "thirds": ("axes.gap = {lin=[0.1, 0.7], n=10}", "axes.gap = {lin=[0.1, 1.3], n=19}", 10),
    "typed otherwise": ("axes.gap = [0.30000000000000004, 0.7]", "axes.gap = [0.3, 0.5, 0.7]", 2),
    "a constant becomes an axis": (
        "constants.gap = 0.30000000000000004\naxes.K0 = [50.0, 100.0]",
        "axes.K0 = [50.0, 100.0]\naxes.gap = {lin=[0.0, 1.0], n=11}", 2),
    "the default becomes an axis": (
        "axes.K0 = [50.0, 100.0]", "axes.K0 = [50.0, 100.0]\naxes.x0 = {lin=[0.05, 0.1], n=6}", 2),
    "a constant": (
        "constants.gap = 0.30000000000000004\naxes.K0 = [50.0, 100.0]",
        "constants.gap = 0.3\naxes.K0 = [50.0, 75.0, 100.0]", 2),
    "cases": (
        "[cases]\nDenv = [0.30000000000000004, 63.2]\ngap = [0.1, 0.2]",
        "[cases]\nDenv = [63.2, 0.3, 7.0]\ngap = [0.2, 0.1, 0.1]", 2),
}  # fmt: skip


@pytest.mark.parametrize(("small", "large", "shared"), PAIRS.values(), ids=PAIRS)
def test_cells_at_a_shared_value_stay_and_only_new_ones_run(tmp_path, small, large, shared):
    store = runner.start(tmp_path / "s.zarr", parse(HEAD + small, "small"), None, 64)
    runner.run(store, lambda progress: None)
    before = dataset(store.path).load()
    larger = extend.extend(open_store(store.path), parse(HEAD + large, "large"), "large")
    assert Counts.of(larger).done == shared
    runner.run(larger, lambda progress: None)
    after = dataset(store.path).load()
    assert not Counts.of(open_store(store.path)).pending
    known = after.nmse.values.ravel()
    assert set(before.nmse.values.ravel()) <= set(known)
    # the store is what an undisturbed run of its own record gives
    again = runner.start(tmp_path / "again.zarr", larger.grid.sweep, None, 64)
    runner.run(again, lambda progress: None)
    np.testing.assert_array_equal(dataset(again.path).nmse.values.ravel(), known)
    for name in before.coords:
        assert set(before[name].values.ravel().tolist()) <= set(after[name].values.ravel().tolist())


@pytest.mark.parametrize("apart", ["0.3000000000001", "0.3000001"])
def test_values_that_differ_by_more_are_two_places(tmp_path, apart):
    store = runner.start(tmp_path / "s.zarr", parse(HEAD + "axes.gap = [0.3, 0.7]", "a"), None, 64)
    larger = parse(HEAD + f"axes.gap = [{apart}, 0.7, 0.8]", "b")
    with pytest.raises(Exception, match=r"`gap` must keep what the store has, but lacks gap = 0.3"):
        extend.extend(store, larger, "b")
