"""`sweeps.run` and `sweeps.load` as a notebook calls them."""

import signal
import threading
import traceback

import jax
import jax.numpy as jnp
import pytest

import sweeps
from sweeps.spec.mistakes import SweepError
from sweeps.spec.types import Reduction
from sweeps.store.opening import Counts, open_store
from tests.test_runner import bits as bits_of

SMALL = {"axes": {"K0": [10.0, 20.0, 50.0, 100.0]}, "constants": {"period": 0.01}, "model": {}}


@pytest.fixture(autouse=True)
def as_python_starts():
    """A worker of pytest may ignore SIGINT."""
    before, x64 = (
        signal.signal(signal.SIGINT, signal.default_int_handler),
        jax.config.jax_enable_x64,
    )
    yield
    signal.signal(signal.SIGINT, before)
    jax.config.update("jax_enable_x64", x64)


@pytest.fixture
def plan():
    large = sweeps.load("period-map")
    time = large.time.model_copy(update={"t_end": 0.1})
    return large.model_copy(update=SMALL | {"time": time})


def frames(error):
    """The functions that a traceback shows below the test's own."""
    return [frame.name for frame in traceback.extract_tb(error.__traceback__)[1:]]


def test_a_stop_waits_for_the_block_and_the_same_call_continues(plan, tmp_path):
    """The stop button of a notebook sends SIGINT."""
    path = tmp_path / "small.zarr"

    def stop(progress):
        if progress.done == 1:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="the same call continues") as caught:
        sweeps.run(plan, path, chunk=1, on_progress=stop)
    assert caught.value.__suppress_context__
    assert frames(caught.value) == ["run"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    done = Counts.of(open_store(path)).cells["ok"]
    assert 1 <= done < 4

    seen = []
    store = sweeps.run(plan, path, chunk=1, on_progress=seen.append)
    assert seen[0].done == done
    assert Counts.of(store).cells["ok"] == 4


def test_a_second_stop_raises_at_once(plan, tmp_path):
    after = []

    def stop(_):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        after.append("still running")

    with pytest.raises(KeyboardInterrupt) as caught:
        sweeps.run(plan, tmp_path / "small.zarr", on_progress=stop)
    assert not caught.value.args
    assert not after


def test_a_stop_in_the_last_block_stops_what_comes_after(plan, tmp_path):
    """As in a loop over sweeps of a block each."""

    def stop(progress):
        if progress.done == progress.cells:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="the sweep is complete"):
        sweeps.run(plan, tmp_path / "small.zarr", on_progress=stop)
    assert Counts.of(open_store(tmp_path / "small.zarr")).cells["ok"] == 4


def test_a_handler_of_the_users_own_stays(plan, tmp_path):
    came = []
    signal.signal(signal.SIGINT, lambda *_: came.append("SIGINT"))
    sweeps.run(
        plan, tmp_path / "small.zarr", on_progress=lambda _: signal.raise_signal(signal.SIGINT)
    )
    assert set(came) == {"SIGINT"}


def test_a_thread_runs_a_sweep(plan, tmp_path):
    stores = []
    thread = threading.Thread(
        target=lambda: stores.append(sweeps.run(plan, tmp_path / "small.zarr"))
    )
    thread.start()
    thread.join(60)
    assert Counts.of(stores[0]).cells["ok"] == 4


def test_a_report_without_news_is_not_passed_on(plan, tmp_path, monkeypatch):
    """A cluster reports twice a second."""
    run = sweeps._run

    def often(sweep, path, client, chunk, on_progress):
        def twice(progress):
            on_progress(progress)
            on_progress(progress)

        return run(sweep, path, client, chunk, twice)

    monkeypatch.setattr(sweeps, "_run", often)
    seen = []
    sweeps.run(plan, tmp_path / "small.zarr", chunk=2, on_progress=seen.append)
    assert [progress.done for progress in seen] == [0, 2, 4]


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("reduced", [False, True])
def test_a_run_has_its_own_precision(plan, tmp_path, bits, reduced):
    """Whatever the caller's is, for the process or in a context, also while the run computes."""
    over = Reduction(over=["K0"], max=["nmse"]) if reduced else None
    plan = plan.model_copy(update={"precision": bits, "error_estimate": True, "reduce": over})
    jax.config.update("jax_enable_x64", bits == 64)
    wanted = bits_of(sweeps.run(plan, tmp_path / "wanted.zarr").path)
    jax.config.update("jax_enable_x64", bits != 64)
    assert bits_of(sweeps.run(plan, tmp_path / "process.zarr").path) == wanted
    with jax.enable_x64(bits == 64):
        jax.config.update("jax_enable_x64", bits != 64)
        assert bits_of(sweeps.run(plan, tmp_path / "outside.zarr").path) == wanted
    with jax.enable_x64(bits != 64):
        jax.config.update("jax_enable_x64", bits == 64)
        assert bits_of(sweeps.run(plan, tmp_path / "inside.zarr").path) == wanted
    assert jax.config.jax_enable_x64 is (bits == 64)
    assert jnp.zeros(1).dtype == f"float{bits}"


@pytest.mark.parametrize("call", [sweeps.run, sweeps.load])
@pytest.mark.parametrize("wrong", [None, 3, {"name": "a"}])
def test_what_is_no_sweep_is_refused(call, wrong):
    with pytest.raises(SweepError, match=r"^sweep must be a Sweep, the path of a sweep file or"):
        call(wrong)


def test_a_store_that_is_not_there_is_no_name_of_the_library():
    with pytest.raises(SweepError, match=r"^gone\.zarr: is no result store: there is nothing"):
        sweeps.load("gone.zarr")


def test_a_mistake_is_one_line_below_the_callers_own(plan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    unknown = "period-mop: is no file and no sweep of the library; did you mean `period-map`?"
    for call in (sweeps.load, sweeps.run):
        with pytest.raises(SweepError) as caught:
            call("period-mop")
        assert str(caught.value) == unknown
    with pytest.raises(SweepError, match=r"^mine\.toml: there is no such file$"):
        sweeps.load("mine.toml")
    (tmp_path / "plain").write_text('name = "plain"\n[axes]\nK0 = [1.0]')
    assert sweeps.load("plain").name == "plain"  # a file may have any name
    sweeps.run(plan, "small.zarr")
    with pytest.raises(SweepError, match=r"^small\.zarr: was begun with another sweep") as caught:
        sweeps.run(plan.model_copy(update={"constants": {"Td": 7.0}}), "small.zarr")
    assert frames(caught.value) == ["run"]
