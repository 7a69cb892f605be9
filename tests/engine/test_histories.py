"""`histories`: the signals of each scenario, labelled."""

import jax
import numpy as np
import pytest

from fic_jax import SIGNALS, Model, Params, ParamsError, histories, rollout
from tests.engine.scenarios import DT, pick, random_batch


@pytest.mark.parametrize("integrator", ["rk4", "rk4_events"])
def test_each_scenario_equals_its_rollout(integrator):
    batch, model = random_batch(5), Model(integrator=integrator)
    data = histories(batch, model=model, dt=DT, n_steps=60)
    assert dict(data.sizes) == {"scenario": 5, "time": 60}
    for i in range(5):
        alone = rollout(pick(batch, i), model=model, dt=DT, n_steps=60)
        for name in SIGNALS:
            got = data.time if name == "t" else data[name].isel(scenario=i)
            np.testing.assert_allclose(got, getattr(alone, name), rtol=1e-9, atol=1e-12)


def test_units_coordinates_and_attributes():
    data = histories(Params(K0=np.array([10.0, 100.0]), Td=3.0), dt=DT, n_steps=4)
    assert data.x.dims == ("scenario", "time")
    assert (data.x.attrs["units"], data.time.attrs["units"]) == ("rad", "s")
    assert data.K0.dims == ("scenario",)
    assert data.K0.values.tolist() == [10.0, 100.0]
    assert data.Td.item() == 3.0
    assert data.attrs["law"] == "algorithm1"
    assert data.attrs["dt"] == DT
    assert data.diverging.dtype == bool


def test_every_third_sample_has_the_work_since_the_last_one():
    batch, run = random_batch(3), {"dt": DT, "n_steps": 30}
    fine, coarse = histories(batch, **run), histories(batch, every=3, **run)
    np.testing.assert_array_equal(coarse.time, fine.time[2::3])
    np.testing.assert_allclose(coarse.x, fine.x[:, 2::3], rtol=1e-12)
    np.testing.assert_allclose(coarse.work.sum("time"), fine.work.sum("time"), rtol=1e-9)


def test_leaves_of_one_element_and_no_scenarios():
    data = histories(Params(K0=np.array([10.0, 100.0]), Td=np.ones(1)), dt=DT, n_steps=3)
    assert (data.K0.dims, data.Td.dims) == (("scenario",), ())
    none = histories(Params(K0=np.zeros(0)), dt=DT, n_steps=3)
    assert dict(none.sizes) == {"scenario": 0, "time": 3}
    np.testing.assert_array_equal(none.time, data.time)


@pytest.mark.parametrize("n_steps", [101, 211])
def test_any_number_of_samples(n_steps):
    data = histories(random_batch(2), dt=DT, n_steps=n_steps)
    alone = rollout(pick(random_batch(2), 0), dt=DT, n_steps=n_steps)
    np.testing.assert_allclose(data.x.isel(scenario=0), alone.x, rtol=1e-9, atol=1e-12)


def test_one_scenario_and_its_dtype():
    data = histories(jax.tree.map(np.float32, Params()), dt=DT, n_steps=3)
    assert dict(data.sizes) == {"scenario": 1, "time": 3}
    assert data.x.dtype == np.float32


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"every": 4}, "`every` must be a divisor of n_steps = 10, but is 4"),
        ({"every": 0}, "`every` must be a whole number"),
        ({"batch": Params(K0=-1.0)}, "`K0` must be positive"),
    ],
)
def test_wrong_arguments_are_refused(changed, message):
    with pytest.raises(ParamsError, match=message):
        histories(**{"batch": Params(), "dt": DT, "n_steps": 10} | changed)
