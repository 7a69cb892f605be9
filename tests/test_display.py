"""What a record shows of itself: readable in text and in HTML, and never an error."""

from html.parser import HTMLParser

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sweeps
from fic_jax import METRICS, SIGNALS, Metrics, Model, Params, evaluate, rollout, sweep
from fic_jax.display import summary
from sweeps.store.opening import open_store


class Cells(HTMLParser):
    """The texts of the cells of a table."""

    def __init__(self, page):
        super().__init__()
        self.texts = []
        self.feed(page)

    def handle_data(self, data):
        self.texts.append(data)


def test_what_differs_from_the_paper_comes_first_with_its_unit():
    shown = repr(Params(K0=np.geomspace(1.0, 1000.0, 64), Td=7))
    first, second, *rest = shown.splitlines()[1:]
    assert first.split("  ")[1:] == [
        "K0",
        "[64] 1 to 1000",
        "N*m/rad",
        "constant stiffness of the controller",
    ]
    assert second.split()[:3] == ["Td", "7", "N*m"]
    assert rest[0].startswith("as in the paper: Fmax = 15 N*m, x0 = 0.1 rad")
    assert not any("Td" in line for line in rest)


@pytest.mark.parametrize("kind", [np.float32, np.float64, jnp.float32, jnp.float64])
def test_a_default_is_one_in_any_precision(kind):
    assert repr(Params(x0=kind(0.1), Denv=kind(189.7))) == repr(Params())


def test_a_model_is_shown_as_python_writes_it():
    for model in (Model(), Model(contact="welded", law="energy")):
        assert eval(repr(model)) == model
    assert repr(Model(contact="welded")) == "Model(contact='welded')"
    texts = Cells(Model(contact="welded")._repr_html_()).texts
    assert texts.index("welded") < texts.index("by default (6)") < texts.index("latched")


def test_metrics_and_signals_show_range_unit_and_meaning():
    metrics = sweep(Params(K0=np.array([1.0, 10.0])), dt=0.01, n_steps=20)
    motion = rollout(Params(), dt=0.01, n_steps=20)
    for record, about in ((metrics, METRICS), (motion, SIGNALS)):
        lines = repr(record).splitlines()[1:]
        assert [line.split()[0] for line in lines] == list(about)
        assert all(line.endswith(about[line.split()[0]]["meaning"]) for line in lines)
        assert {field["meaning"] for field in about.values()} <= set(
            Cells(record._repr_html_()).texts
        )
    assert "2 of 2 true" in repr(metrics)
    assert "True" in repr(evaluate(Params(), dt=0.01, n_steps=20))


def deleted():
    array = jnp.ones(3)
    array.delete()
    return array


def test_any_leaf_has_a_summary():
    leaves = [
        (1.0, "1"),
        (jnp.arange(6).reshape(2, 3), "[2 x 3] 0 to 5"),
        (np.array([np.nan, 2.0, np.inf]), "[3] 2 to inf"),
        (jnp.array([np.nan, 2.0, np.inf]), "[3] 2 to inf"),
        (np.array([np.nan]), "[1] nan"),
        (jnp.array([np.nan]), "[1] nan"),
        (np.ones(4), "[4] 1"),
        (np.zeros(0), "float64[0]"),
        ([1, 2], "[2] 1 to 2"),
        (np.array([True, False]), "1 of 2 true"),
        (None, "NoneType"),
        (object(), "object"),
        ("text", "str"),
        (deleted(), "float64[3]"),
        (jax.ShapeDtypeStruct((3,), np.float32), "float32[3]"),
    ]
    for value, shown in leaves:
        assert summary(value) == shown
        assert shown in repr(jax.tree.map(lambda _, leaf=value: leaf, Params()))


def test_tracers_are_named_in_every_transformation():
    seen = []

    def look(p):
        seen.append(repr(p) + p._repr_html_())
        # an array that is not traced, while something else is
        seen.append(repr(Params(K0=jnp.array([3.0, 4.0]), Td=p.Td)))
        return p.K0 * 2.0

    p = Params(**{name: jnp.asarray(value) for name, value in vars(Params()).items()})
    many = jax.tree.map(lambda leaf: jnp.full(3, leaf), p)
    jax.jit(look)(p)
    jax.vmap(look)(many)
    jax.grad(look)(p)
    jax.jit(jax.vmap(jax.grad(look)))(many)
    assert len(seen) == 8
    assert all("traced float64[]" in text for text in seen)


def test_of_a_large_array_only_the_ends_leave_the_device(monkeypatch):
    leaf, fetched = jnp.linspace(0.0, 1.0, 1_000_000), []
    get = jax.device_get

    def counted(tree):
        fetched.extend(jax.tree.leaves(tree))
        return get(tree)

    monkeypatch.setattr(jax, "device_get", counted)
    with jax.transfer_guard("disallow"):
        assert summary(leaf) == "[1,000,000] 0 to 1"
    assert [np.size(each) for each in fetched] == [1, 1]


def test_html_escapes_what_it_shows():
    class Odd:
        pass

    Odd.__name__ = "<b>"
    assert "<b>" not in Params(K0=Odd())._repr_html_()


def test_a_partly_made_record_can_be_shown():
    """As a debugger does, before `__init__`."""
    assert repr(object.__new__(Params)) == "Params"
    assert repr(Metrics.__new__(Metrics)) == "Metrics"


def test_a_sweep_shows_its_axes_before_its_defaults():
    lines = repr(sweeps.load("atlas-small")).splitlines()
    assert lines[0].startswith("Sweep atlas-small: K0 ")
    assert lines[0].endswith("= 1,008,000 scenarios of 1,000 steps")
    assert lines[1].split()[0] == "K0"
    assert "1 to 1000, log" in lines[1]
    assert any(line.startswith("by default: Fmax = 15 N*m") for line in lines)
    for name in ("atlas-billion", "paper-welded", "period-map"):
        assert "N*m/rad" in sweeps.load(name)._repr_html_()


def test_a_store_shows_how_far_it_is_even_if_it_is_damaged(tmp_path):
    path, lines = tmp_path / "small.zarr", []
    plan = sweeps.load("period-map").model_copy(
        update={"axes": {"K0": [10.0, 100.0]}, "constants": {"period": 0.01}, "model": {}}
    )
    plan = plan.model_copy(update={"time": plan.time.model_copy(update={"t_end": 0.1})})
    store = sweeps.run(plan, path, on_progress=lambda progress: lines.append(str(progress)))
    assert lines[0] == "0 of 2 cells (0 %)"
    assert lines[-1].startswith("2 of 2 cells (100 %), ")
    assert f"Store {path}" in repr(store)
    assert "ok         2" in repr(store)
    assert "ok" in Cells(store._repr_html_()).texts
    (path / "ledger.sqlite").unlink()
    assert "ledger.sqlite is missing" in repr(open_store(path))


def test_a_refined_sweep_shows_its_coarse_grid():
    lines = repr(sweeps.load("convergence-boundary")).splitlines()
    assert "contact 2 x sigma 33 x Denv 33 = 2,178 scenarios of 1,000 steps, refined" in lines[0]
    (row,) = (line for line in lines if line.startswith("  refine "))
    assert "levels 5, budget 100,000" in row and "sigma, Denv halved where cells differ" in row
