"""Wrong calls: one line that names the argument and what would be right; numbers of other types."""

import pickle
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction

import jax
import ml_dtypes  # of jax
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.sparse import csr_array

from fic_jax import (
    Model,
    Params,
    ParamsError,
    control,
    energy,
    evaluate,
    evaluate_with_error,
    force,
    histories,
    init,
    rollout,
    step,
    sweep,
    trusted,
    tune_for_throughput,
)

RUN = {"dt": 0.01, "n_steps": 5}
P = Params()
THREE = np.ones(3)


class Quantity:
    """As pint's: NumPy takes its number and drops its unit."""

    units = "N*m"

    def __array__(self, dtype=None, copy=None):
        return np.asarray(3.0)

    def __repr__(self):
        return "<Quantity(3.0)>"


class Column(np.ndarray):
    """As astropy's: an array with a unit."""

    unit = "N*m"


class Fails:
    """As a tensor that is on another device or requires a gradient."""

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("not on this device")


WRONG = [
    (lambda: sweep({"K0": 1.0}, **RUN), "`batch` must be of type Params, such as Params(K0="),
    (lambda: sweep(pd.DataFrame({"K0": [1.0]}), **RUN), "but is of type DataFrame."),
    (lambda: sweep(None, **RUN), "`batch` must be of type Params"),
    (lambda: sweep(Model(), **RUN), "but is Model()."),
    (lambda: evaluate(Params, **RUN), "`params` must be of type Params"),
    (lambda: evaluate({"K0": 1.0}, **RUN), "`params` must be of type Params"),
    (lambda: rollout(None, **RUN), "`params` must be of type Params"),
    (lambda: init("welded"), "`params` must be of type Params"),
    (lambda: force(0.1, {"K0": 1.0}), "`p` must be of type Params"),
    (lambda: energy(P, 0.1), "`p` must be of type Params"),
    (lambda: evaluate(P, model="effort", **RUN), "such as Model(law=\"effort\"), but is 'effort'."),
    (lambda: sweep(P, model="welded", **RUN), 'such as Model(contact="welded")'),
    (lambda: step(P, init(P), model=Model, dt=0.01), "`model` must be of type Model"),
    (lambda: init(P, "welded"), "`model` must be of type Model"),
    (lambda: evaluate(P, dt="0.01", n_steps=5), "`dt` must be a positive number of seconds, but"),
    (
        lambda: sweep(P, dt=None, n_steps=5),
        "`dt` must be a positive number of seconds, but is None",
    ),
    (lambda: step(P, init(P), dt="0.01"), "`dt` must be a real number"),
    (lambda: evaluate(P, dt=-0.01, n_steps=5), "`dt` must be positive and finite, but is -0.01."),
    (lambda: sweep(P, dt=THREE, n_steps=5), "`dt` must be one number of seconds for all"),
    (
        lambda: evaluate(P, dt=0.01, n_steps=10.5),
        "`n_steps` must be a whole number, at least 1, but",
    ),
    (lambda: evaluate(P, dt=0.01, n_steps=True), "`n_steps` must be a whole number"),
    (lambda: rollout(P, dt=0.01, n_steps="10"), "`n_steps` must be a whole number"),
    (lambda: histories(P, dt=0.01, n_steps=None), "`n_steps` must be a whole number"),
    (lambda: sweep(P, dt=0.01, n_steps=np.float64(5)), "`n_steps` must be a whole number"),
    (lambda: histories(P, every=0.5, **RUN), "`every` must be a whole number"),
    (
        lambda: Params(k3=1.0),
        "unknown field `k3` of Params; did you mean `K0` (constant stiffness of the controller, in",
    ),
    (
        lambda: Params(kenv=1.0),
        "unknown field `kenv` of Params; did you mean `Kenv` (stiffness of the",
    ),
    (
        lambda: replace(P, stiffness=1.0),
        "did you mean `K0` (constant stiffness of the controller, in",
    ),
    (lambda: Params(foo=1.0), "unknown field `foo` of Params; known are K0, Fmax"),
    (lambda: Params(inertia=1.0), "did you mean `I` (inertia, in kg*m^2)?"),
    (lambda: Model(laws="effort"), "unknown field `laws` of Model; did you mean `law`?"),
    (lambda: Model(law="algoritm1"), "`law` must be one of algorithm1, effort, energy, but is"),
    (
        lambda: step(P, init(P).memory, dt=0.01),
        "`state` must be of type State, such as init(params)",
    ),
    (lambda: step(P, replace(init(P), k=1.5), dt=0.01), "`k` must be a whole number, but is 1.5."),
    (lambda: step(P, replace(init(P), v=None), dt=0.01), "`v` must be a real number"),
    (lambda: control(P, init(P), 0.0, 0.0, 0.0, dt=0.01), "`memory` must be of type Memory"),
    (lambda: control(P, init(P).memory, "0", 0.0, 0.0, dt=0.01), "`x` must be a real number"),
    (lambda: control(P, init(P).memory, 0.0, 0.0, None, dt=0.01), "`tau_measured` must be a real"),
    (lambda: force("0.1", P), "`e` must be a real number"),
    (
        lambda: sweep(P, backend="gpu", **RUN),
        "`backend` must be one of auto, lanes, ptx, xla, pallas",
    ),
    (lambda: sweep(P, error_estimate="no", **RUN), "`error_estimate` must be True or False"),
    (lambda: evaluate(Params(K0=THREE), **RUN), "`K0` must be a scalar (sweep takes [N] leaves"),
    (
        lambda: sweep(Params(K0=THREE, Td=[1.0, 2.0]), **RUN),
        "`batch` must be scalars and [N] arrays",
    ),
    (lambda: trusted(P, P, 10.0), "`metrics` must be of type Metrics"),
    (lambda: trusted(*sweep(P, error_estimate=True, **RUN), "10"), "`t_end` must be a real number"),
    (lambda: tune_for_throughput("2"), "`devices` must be a whole number, at least 1, but is '2'."),
    (
        lambda: jax.vmap(lambda K0: sweep(Params(K0=K0), **RUN).nmse)(THREE),
        "`K0` must be known outside of jit, vmap and grad (inside, use jax.vmap of evaluate)",
    ),
    (
        lambda: jax.vmap(lambda K0: histories(Params(K0=K0), **RUN).x)(THREE),
        "`K0` must be known outside of jit, vmap and grad (inside, use jax.vmap of rollout)",
    ),
    (
        lambda: jax.vmap(lambda dt: sweep(P, dt=dt, n_steps=5).nmse)(0.01 * THREE),
        "`dt` must be known outside of jit",
    ),
    (
        lambda: jax.jit(lambda n: evaluate(P, dt=0.01, n_steps=n).nmse)(5),
        "`n_steps` must be a whole number, at least 1, and static, but is traced",
    ),
]


@pytest.mark.parametrize(("call", "message"), WRONG, ids=[message for _, message in WRONG])
def test_a_wrong_call_gets_one_line_that_says_what_would_be_right(call, message):
    with pytest.raises(ParamsError) as caught:
        call()
    text = str(caught.value)
    assert message in text
    assert "\n" not in text
    assert len(text) < 250


def test_an_unknown_field_is_the_type_error_that_python_raises():
    with pytest.raises(TypeError):
        Params(k3=1.0)


NO_NUMBERS = {
    "text": "5",
    "texts": ["5", "6"],
    "nothing": None,
    "object": object(),
    "function": len,
    "bool": True,
    "bools": np.array([True, False]),
    "complex": 1j,
    "complex of JAX": jax.numpy.array(1j),
    "masked array": np.ma.masked_array([1.0, 2.0], [False, True]),
    "masked": np.ma.masked,
    "masked in a list": [np.ma.masked, 1.0],
    "no date": np.datetime64("NaT", "s"),
    "duration": np.timedelta64(1, "s"),
    "date": pd.Timestamp("2020-01-01"),
    "missing": pd.NA,
    "missing in a list": [1.0, None],
    "category": pd.Series(["a"], dtype="category"),
    "sparse": csr_array(np.eye(2)),
    "unit": Quantity(),
    "array with a unit": np.array([1.0, 2.0]).view(Column),
    "labelled array with a unit": xr.DataArray(np.array([1.0, 2.0]).view(Column)),
    "another device": Fails(),
    "record": np.zeros(2, [("a", float)]),
    "ragged": [[1.0], [1.0, 2.0]],
    "too large": 10**400,
    "random key": jax.random.key(0),
    "Params": P,
}
ENTRIES = {
    "sweep": lambda p: sweep(p, **RUN),
    "histories": lambda p: histories(p, **RUN),
    "evaluate": lambda p: evaluate(p, **RUN),
    "errors": lambda p: evaluate_with_error(p, **RUN),
    "rollout": lambda p: rollout(p, **RUN),
    "step": lambda p: step(p, init(P), dt=0.01),
    "control": lambda p: control(p, init(P).memory, 0.0, 0.0, 0.0, dt=0.01),
    "init": init,
    "force": lambda p: force(0.1, p),
    "energy": lambda p: energy(0.1, p),
}


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("kind", NO_NUMBERS)
def test_what_is_no_real_number_is_refused_by_its_field(kind, entry):
    with pytest.raises(ParamsError, match=r"^`Td` must be a real number in N\*m or an array of"):
        ENTRIES[entry](Params(Td=NO_NUMBERS[kind]))


@pytest.mark.parametrize("value", ["a", b"a", np.str_("5"), 1j, np.complex128(2)])
def test_a_text_and_a_complex_number_are_refused_when_params_are_made(value):
    for make in (lambda: Params(1.0, Td=value), lambda: replace(P, Td=value)):
        with pytest.raises(
            ParamsError, match=r"^`Td` must be a real number in N\*m or an array of"
        ):
            make()


def test_jax_may_put_anything_into_the_leaves():
    shape = jax.ShapeDtypeStruct((3,), np.float32)
    for leaf in (None, object(), shape, jax.P("x"), 0, True):
        assert Params(K0=leaf).K0 is leaf
    leaves, structure = jax.tree.flatten(P)
    for leaf in ("train", 1j, object(), shape, jax.P("x"), None):
        assert jax.tree.unflatten(structure, [leaf] * len(leaves)).v_init is leaf
    labels = jax.tree_util.tree_map_with_path(lambda path, _: jax.tree_util.keystr(path), P)
    assert labels.K0 == ".K0" and pickle.loads(pickle.dumps(labels)).gap == ".gap"
    axes = Params(**dict.fromkeys(vars(P)) | {"K0": 0})
    many = replace(P, K0=np.arange(1.0, 4.0))
    assert jax.vmap(lambda p: p.K0 * p.Td, in_axes=(axes,))(many).shape == (3,)
    assert jax.eval_shape(jax.jit(lambda p: replace(p, Td=p.K0)), P).Td.shape == ()


def test_unflatten_calls_no_constructor(monkeypatch):
    monkeypatch.setattr(Params, "__init__", lambda *_, **__: 1 / 0)
    assert jax.tree.map(lambda leaf: 2 * leaf, P).Td == 2 * P.Td


@pytest.mark.parametrize(
    "values",
    [
        [50, 100],
        (50.0, 100.0),
        np.array([50, 100], np.uint8),
        np.array([50, 100], np.float16),
        np.array([50, 100], np.longdouble),
        np.array([50, 100], object),
        jax.numpy.array([50, 100], jax.numpy.bfloat16),
        [Fraction(50), Decimal(100)],
        pd.Series([50.0, 100.0]),
        pd.Series([50, 100], dtype="Int64"),
        xr.DataArray([50.0, 100.0], attrs={"units": "N*m/rad"}),
    ],
    ids=lambda values: f"{type(values).__name__} {getattr(values, 'dtype', '')}",
)
def test_real_numbers_of_any_library_are_taken(values):
    expected = sweep(Params(K0=np.array([50.0, 100.0])), **RUN).nmse
    np.testing.assert_allclose(sweep(Params(K0=values), **RUN).nmse, expected, rtol=1e-5)


@pytest.mark.parametrize("n_steps", [np.int32(5), np.array(5), jax.numpy.array(5)])
def test_whole_numbers_of_any_library_are_taken(n_steps):
    expected = float(evaluate(P, **RUN).nmse)
    assert float(evaluate(P, dt=np.array(0.01), n_steps=n_steps).nmse) == expected


def test_a_value_beyond_single_precision_is_refused():
    with pytest.raises(ParamsError, match="`K0` must be positive and finite, but is inf"):
        evaluate(Params(K0=1e300, Td=np.float32(5.0)), **RUN)


METRICS, ERRORS = sweep(Params(K0=np.array([50.0, 60.0])), dt=0.01, n_steps=5, error_estimate=True)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        *(
            (lambda t=t: trusted(METRICS, ERRORS, t), "`t_end` must be a number, positive and fin")
            for t in (np.inf, -1.0, 0.0, np.nan, np.array([0.05, 0.06]))
        ),
        (
            lambda: trusted(jax.tree.map(lambda leaf: leaf[:1], METRICS), ERRORS, 0.05),
            "`errors` must be of the metrics' shape, (1,), but is of shape (2,).",
        ),
        (lambda: trusted(replace(METRICS, nmse="x"), ERRORS, 0.05), "`nmse` must be a real number"),
        (lambda: Model(law=np.array("effort")), "`law` must be one of algorithm1, effort, energy"),
        (lambda: rollout(P, dt=0.01, n_steps=2**40), "`n_steps` must be at most 2,147,483,647"),
        (
            lambda: step(P, replace(init(P), k=2**31), dt=0.01),
            "`k` must be from 0 to 2,147,483,646",
        ),
        (
            lambda: control(P, replace(init(P).memory, slopes=[0.0]), 0.0, 0.0, 0.0, dt=0.01),
            "`slopes` must be of type Slopes, such as None, but is [0.0].",
        ),
    ],
)
def test_what_a_trial_found_to_be_accepted_or_raw(call, message):
    with pytest.raises(ParamsError) as refused:
        call()
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_trusted_passes_a_transfer_guard():
    with jax.transfer_guard("disallow"):
        assert trusted(METRICS, ERRORS, 0.05).finite.all()


@pytest.mark.parametrize(
    "call", [lambda: Params(k3=1.0), lambda: evaluate(Params(K0=-1.0), dt=0.01, n_steps=5)]
)
def test_an_error_can_be_pickled(call):
    """A pool of processes sends it to the one that waits; it broke the pool."""
    with pytest.raises(ParamsError) as refused:
        call()
    again = pickle.loads(pickle.dumps(refused.value))
    assert type(again) is type(refused.value) and str(again) == str(refused.value)
    assert (again.key, again.wanted) == (refused.value.key, refused.value.wanted)


@pytest.mark.parametrize("kind", ["bfloat16", "float8_e5m2", "float8_e4m3fn", "int4"])
def test_a_scalar_of_low_precision_is_a_number(kind):
    value = np.dtype(getattr(ml_dtypes, kind)).type(4)
    got = evaluate(Params(K0=value), dt=0.01, n_steps=5)
    single = evaluate(Params(K0=np.float32(4.0)), dt=0.01, n_steps=5)
    assert float(got.nmse) == pytest.approx(float(single.nmse), rel=1e-6)  # int4: in double
