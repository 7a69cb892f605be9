"""Two real workers of Dask, and the store of an undisturbed run."""

import multiprocessing
import os
from multiprocessing import forkserver
from pathlib import Path

import pytest

from sweeps import cluster, runner
from sweeps.spec.reading import parse
from tests.cluster import sabotage

TEXT = """
name = "many"
[time]
t_end = 0.2
[axes]
K0 = { log = [1.0, 100.0], n = 6 }
Td = [1.0, 5.0, 12.0]
"""
PLAN = parse(TEXT, "many.toml")
BLOCKS = 18


@pytest.fixture(autouse=True)
def _often(monkeypatch):
    monkeypatch.setattr(cluster, "LOOK", 0.1)


@pytest.fixture(scope="session")
def folder_of_sabotage(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sabotage")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(sabotage.VARIABLE, str(folder))
        yield folder


@pytest.fixture(scope="package")
def workers(folder_of_sabotage):
    """A client with two workers that can be sabotaged."""
    distributed = pytest.importorskip("distributed", reason="needs the extra `dask`")
    import dask.config

    # A worker is a fork of a process that has imported all: it starts in a tenth of a second
    # instead of three. JAX has not started in that process.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["distributed", "sweeps.worker"])
    forkserver.ensure_running()
    preload = ["sweeps.worker", os.path.abspath(sabotage.__file__)]
    settings = {
        "distributed.deploy.lost-worker-timeout": 60,
        "distributed.worker.multiprocessing-method": "forkserver",
    }
    with (
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
            memory_limit=0, silence_logs=50, preload=preload,
            # other tests may have started the process that is forked, without the variable
            env={sabotage.VARIABLE: str(folder_of_sabotage)},
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):  # fmt: skip
        yield client


@pytest.fixture
def client(workers):
    workers.wait_for_workers(2, timeout=20)
    return workers


@pytest.fixture
def sabotaged(folder_of_sabotage):
    """`sabotaged(action, text)` makes blocks go wrong, until `sabotaged.end()` or the end."""

    def sabotage(action, text=""):
        (folder_of_sabotage / action).write_text(str(text))

    def end():
        for file in folder_of_sabotage.iterdir():
            file.unlink(missing_ok=True)

    sabotage.end = end
    yield sabotage
    end()


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    store = runner.start(tmp_path_factory.mktemp("whole") / "many.zarr", PLAN, 1, 32)
    runner.run(store, lambda _: None)
    return Path(store.path)
