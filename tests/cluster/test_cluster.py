"""A run on real Dask workers: the files of a serial run, whatever dies, hangs or is refused."""

import contextlib
import logging
import os
import random
import re
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

import fic_jax
import sweeps
from fic_jax.lanes import mapping
from sweeps import cluster, runner, worker
from sweeps.cluster import Cluster, Task
from sweeps.export import write
from sweeps.spec.mistakes import SweepError
from sweeps.store.commit import writing
from sweeps.store.fsync import PARTIAL
from sweeps.store.ledger import SET_ASIDE
from sweeps.store.opening import Counts, dataset, open_store
from tests.cluster.conftest import BLOCKS, PLAN, TEXT
from tests.command import typed
from tests.torture import TORTURE, many

distributed = pytest.importorskip("distributed", reason="needs the extra `dask`")


def start(path):
    return runner.start(path / "many.zarr", PLAN, 1, 32)


def run(store, client, on_progress=lambda _: None):
    return runner.run(store, on_progress, run_blocks=Cluster(client, store).run_blocks)


def same_files(store, whole):
    """Every block has a row once, and every file the bits of the serial run."""
    mine, theirs = open_store(store.path).rows(), open_store(whole).rows()
    assert [row.block for row in mine] == list(range(BLOCKS))
    assert [row.files for row in mine] == [row.files for row in theirs]
    for row in mine:
        for path, checksum in store.files(row):
            assert path.stat().st_size == checksum.size
    assert not list(store.path.rglob(f"*{PARTIAL}"))


def test_the_files_of_a_serial_run(tmp_path, client, whole):
    store = start(tmp_path)
    seen = []
    result = run(store, client, seen.append)
    assert (result.done, result.ran, result.set_aside) == (BLOCKS, BLOCKS, ())
    assert [p.done for p in seen] == sorted(p.done for p in seen)
    same_files(store, whole)


def test_from_python(tmp_path, client, whole):
    file = tmp_path / "many.toml"
    file.write_text(TEXT)
    seen = []
    for _ in range(2):  # the second call finds it complete
        store = sweeps.run(file, tmp_path / "a.zarr", client=client, on_progress=seen.append)
        assert Counts.of(store).done == BLOCKS
    assert seen[-1].ran == 0
    same_files(sweeps.run(PLAN, tmp_path / "b.zarr", client=client, chunk=1), whole)


def test_workers_that_are_killed(tmp_path, client, whole, sabotaged):
    """The kills come at random times; in the torture test 20 of them."""
    kills, store = many(3, 20), start(tmp_path)
    sabotaged("slow", 0.3 if kills == 3 else 2.0)
    over, killed, rng = threading.Event(), [], random.Random(5)

    def kill():
        before = set()  # Dask does not restart a worker that dies while it is being started
        while len(killed) < kills and not over.wait(rng.uniform(0.3, 1.0)):
            pids = set(client.run(os.getpid, on_error="ignore").values())
            old, before = sorted(pids & before), pids
            if old:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(rng.choice(old), signal.SIGKILL)
                    killed.append(1)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        result = run(store, client)
    finally:
        over.set()
        thread.join()
    assert len(killed) >= 2
    assert (result.done, result.ran, result.set_aside) == (BLOCKS, BLOCKS, ())
    same_files(store, whole)


def test_a_block_that_kills_its_worker_is_set_aside(
    tmp_path, client, whole, sabotaged, monkeypatch
):
    monkeypatch.setattr(cluster, "ATTEMPTS", attempts := many(2, runner.ATTEMPTS))
    store = start(tmp_path)
    sabotaged("kill", store.grid.block(4))
    result = run(store, client)
    (row,) = result.set_aside
    assert (row.block, row.outcome, row.attempt) == (4, SET_ASIDE, attempts)
    assert row.error == f"killed its worker {attempts} times"
    assert (result.done, result.ran) == (BLOCKS - 1, BLOCKS - 1)
    sabotaged("kill", "no block")
    again = run(runner.reopen(store.path, 32), client)
    assert (again.ran, again.set_aside) == (1, ())
    same_files(store, whole)


def test_a_block_that_fails_is_set_aside(tmp_path, client, whole, sabotaged):
    store = start(tmp_path)
    sabotaged("fail", store.grid.block(4))
    (row,) = run(store, client).set_aside
    assert (row.block, row.attempt, row.error) == (4, runner.ATTEMPTS, "MemoryError: no room")
    sabotaged("fail", "no block")
    run(runner.reopen(store.path, 32), client)
    same_files(store, whole)


def test_a_worker_that_hangs_is_restarted(tmp_path, client, whole, sabotaged, monkeypatch):
    monkeypatch.setattr(cluster, "HANG_FIRST", 2.0)
    monkeypatch.setattr(cluster, "HANG_LEAST", 2.0)
    store = start(tmp_path)
    sabotaged("hang")
    with pytest.warns(RuntimeWarning, match=r"^worker tcp://\S+ hangs at block \d+"):
        result = run(store, client)
    assert (result.done, result.set_aside) == (BLOCKS, ())
    same_files(store, whole)


def test_a_stop_keeps_what_is_finished(tmp_path, client, whole):
    store = start(tmp_path)

    def stop(progress):
        if progress.done >= 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(store, client, stop)
    done = Counts.of(store).done
    assert 5 <= done < BLOCKS
    assert run(runner.reopen(store.path, 32), client).ran == BLOCKS - done
    same_files(store, whole)


def test_a_late_duplicate_changes_no_finished_block(tmp_path, client, whole):
    store = start(tmp_path)
    with writing(store):
        job = Cluster(client, store).job
        (store.path / job.probe).write_text(job.probe)
        receipt = worker.compute(job, 0, None, 1)
        (store.path / "nmse" / f"c.0.0{receipt.suffix}").unlink()  # a run has tidied up
    run(store, client)
    (store.path / job.probe).write_text(job.probe)
    assert worker.compute(job, 0, None, 1).row.files == receipt.row.files  # late
    assert list(store.path.rglob(f"*{PARTIAL}"))
    with writing(store):
        pass
    same_files(store, whole)


# --- what a run refuses --------------------------------------------------------------------------


def set_numerics(value):
    fic_jax.NUMERICS = value


def test_a_worker_with_another_version_is_not_used(tmp_path, client, whole):
    address, other = client.nthreads()
    client.run(set_numerics, 99, workers=[address])
    try:
        store = start(tmp_path)
        why = rf"its numerics is 99, not {fic_jax.NUMERICS}"
        with pytest.warns(RuntimeWarning, match=f"^worker {address} is not used: {why}$"):
            run(store, client)
        same_files(store, whole)
        client.run(set_numerics, 99, workers=[other])
        store = runner.start(tmp_path / "none.zarr", PLAN, 1, 32)
        with (
            pytest.warns(RuntimeWarning),
            pytest.raises(SweepError, match=rf"none\.zarr: no worker can run it: tcp://.*{why}"),
        ):
            run(store, client)
    finally:
        client.run(set_numerics, fic_jax.NUMERICS)
    run(store, client)
    same_files(store, whole)


def test_a_worker_that_is_used_may_go_while_another_is_refused(tmp_path, client, whole, sabotaged):
    """Its nanny starts it again: until then, the other one is the only worker."""
    wrong, right = client.nthreads()
    client.run(set_numerics, 99, workers=[wrong])
    pid = client.run(os.getpid, workers=[right])[right]
    sabotaged("slow", 0.1)
    store, killed = start(tmp_path), []

    def kill(progress):
        if progress.done >= 2 and not killed:
            killed.append(os.kill(pid, signal.SIGKILL))

    try:
        with pytest.warns(RuntimeWarning, match="its numerics is 99"):
            result = run(store, client, kill)
    finally:
        client.run(set_numerics, fic_jax.NUMERICS, workers=[wrong])
    assert killed
    assert (result.done, result.set_aside) == (BLOCKS, ())
    same_files(store, whole)


def set_cores(cores):
    os.sched_setaffinity(0, cores)


@pytest.mark.skipif(len(mapping.usable_cores()) < 2, reason="needs two cores")
def test_workers_of_a_host_share_the_cores_that_both_may_use(tmp_path, client):
    """A scheduler may give each worker cores of its own, which it uses alone."""
    both = client.nthreads()
    every = mapping.usable_cores()
    first = {min(every)}
    try:
        for cores, sharing in (((every, every), 2), ((first, every - first), 1)):
            for address, own in zip(both, cores, strict=True):
                client.run(set_cores, own, workers=[address])
            store = start(tmp_path / str(sharing))
            workers = Cluster(client, store)
            runner.run(store, lambda _: None, run_blocks=workers.run_blocks)
            assert [hand.job.sharing for hand in workers.hands.values()] == [sharing] * 2
    finally:
        client.run(set_cores, every)


def test_a_worker_that_does_not_see_the_store_is_not_used(tmp_path, client):
    store = start(tmp_path)
    workers = Cluster(client, store)
    workers.job = replace(workers.job, store="/nowhere/many.zarr")
    sees = "can't use the folder /nowhere/many.zarr: No such file or directory"
    with pytest.warns(RuntimeWarning), pytest.raises(SweepError, match=sees):
        runner.run(store, lambda _: None, run_blocks=workers.run_blocks)


def test_a_worker_that_hangs_while_it_gets_ready_is_not_used(
    tmp_path, client, whole, sabotaged, monkeypatch
):
    """The other one begins meanwhile."""
    sabotaged("deaf-1")

    def no_patience(progress):
        if progress.done:
            monkeypatch.setattr(cluster, "READY", 0.0)
            monkeypatch.setattr(cluster, "LOOK", 0.0)

    store, hangs = start(tmp_path), r"is not used: it hangs: it is not ready after 0 s$"
    with pytest.warns(RuntimeWarning, match=rf"^worker tcp://\S+ {hangs}"):
        result = run(store, client, no_patience)
    assert (result.done, result.set_aside) == (BLOCKS, ())
    same_files(store, whole)


def test_a_run_that_no_worker_can_do_leaves_nothing(tmp_path, client, sabotaged, monkeypatch):
    """Exit 2; a store that was there before stays."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "many.toml").write_text(TEXT)
    monkeypatch.setattr(cluster, "READY", 0.0)
    there = start(tmp_path / "there")
    for words in (
        ("run", "many.toml", "--chunk", "1", "--out", "new/folder/many.zarr"),
        ("run", "many.toml", "--chunk", "1", "--shard", "1/2"),
        ("resume", there.path),
    ):
        for name in ("deaf-1", "deaf-2"):
            sabotaged(name)
        with pytest.warns(RuntimeWarning, match="is not used: it hangs"):
            ended = typed(*words, "--dask", client.scheduler.address)
        assert ended.code == 2
        (line,) = [line for line in ended.stderr.splitlines() if "dashboard" not in line]
        assert re.search(r"many\S*\.zarr: no worker can run it: tcp://\S+: it hangs: it is", line)
        sabotaged.end()
    sabotaged("deaf-1")
    sabotaged("deaf-2")
    with pytest.warns(RuntimeWarning), pytest.raises(SweepError, match="no worker can run it"):
        sweeps.run(PLAN, tmp_path / "python.zarr", client=client)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "many.toml", tmp_path / "there"]
    assert open_store(there.path).rows() == []


def test_dask_itself_says_nothing(monkeypatch):
    """Its table of packages, its traceback after the end of a scheduler: we say it in one line."""
    said = {"warning": "Mismatched versions found"}
    monkeypatch.setattr(distributed.versions, "error_message", lambda *_, **__: said)
    with (
        distributed.LocalCluster(
            n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0", silence_logs=50
        ) as scheduler,
        cluster.connected(scheduler.scheduler_address),
    ):
        for name in ("distributed", "distributed.client", "distributed.core"):
            assert not logging.getLogger(name).isEnabledFor(logging.ERROR)


WITHOUT_PACKAGE = """
import asyncio, sys
from distributed import Worker
sys.modules["sweeps"] = None
async def work():
    async with Worker(sys.argv[1], nthreads=1, host="127.0.0.1", dashboard=False) as worker:
        await worker.finished()
asyncio.run(work())
"""


def test_a_scheduler_without_workers_or_with_one_without_the_package(tmp_path, monkeypatch, whole):
    monkeypatch.setattr(cluster, "WORKERS", 0.5)
    store = start(tmp_path)
    with (
        distributed.LocalCluster(
            n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0", silence_logs=50
        ) as scheduler,
        cluster.connected(scheduler.scheduler_address) as client,
    ):
        with pytest.raises(OSError, match=r"^tcp://127.0.0.1:\d+ has had no worker for 0 s$"):
            run(store, client)
        words = [sys.executable, "-c", WITHOUT_PACKAGE, scheduler.scheduler_address]
        process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
        try:
            client.wait_for_workers(1, timeout=30)
            with (
                pytest.warns(RuntimeWarning, match=r"is not used: has no such fic-jax"),
                pytest.raises(SweepError, match=r"no worker can run it: \S+: has no such fic-jax"),
            ):
                run(store, client)
        finally:
            process.kill()
            process.wait()


@pytest.mark.skipif(not TORTURE, reason="takes 10 s; `make torture` runs it")
def test_a_scheduler_that_dies(tmp_path, sabotaged, whole):
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
        memory_limit=0, silence_logs=50,
    ) as scheduler:  # fmt: skip
        client = distributed.Client(scheduler.scheduler_address, timeout=5)
        store = start(tmp_path)

        def close(progress):
            if progress.done == 5:
                scheduler.close()

        with pytest.raises(OSError, match="the scheduler does not answer any more"):
            run(store, client, close)
        client.close()
    assert 5 <= Counts.of(store).done < BLOCKS


def test_places():
    assert cluster.check_place("local:4") == 4
    assert cluster.check_place("tcp://10.0.0.1:8786") == 0
    for wrong in ("local:0", "local", "host", "tcp://host", "4"):
        with pytest.raises(SweepError, match=re.escape(f"--dask {wrong}: must be local:N with")):
            cluster.check_place(wrong)


def test_suspects_are_alone():
    hand = cluster.Hand("tcp://a:1", None, new=False)
    task, suspect = Task(1), Task(2).after_death(alone=True)
    assert hand.free_for(task)
    assert hand.free_for(suspect)
    hand.tasks = {"future": task}
    assert hand.free_for(task)
    assert not hand.free_for(suspect)
    hand.tasks = {"future": suspect}
    assert not hand.free_for(task)


def test_a_new_worker_computes_at_once_but_no_suspect():
    """Its nanny would not restart it if it died now."""
    hand = cluster.Hand("tcp://a:1", None)
    assert hand.free_for(Task(1))
    assert not hand.free_for(Task(2).after_death(alone=True))


def test_the_script_of_the_page(tmp_path, whole):
    """docs/clusters.md, as a user's own file."""
    page = (Path(__file__).parent.parent.parent / "docs" / "clusters.md").read_text("utf-8")
    (script,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    script = script.replace("client=client", "client=client, chunk=1")
    (tmp_path / "script.py").write_text(script.replace("n_workers=2", "n_workers=1"))
    (tmp_path / "mine.toml").write_text(TEXT)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    same_files(open_store(tmp_path / "mine.zarr"), whole)


def test_a_client_of_the_user_keeps_no_file_from_being_written(client, whole, tmp_path):
    """xarray would lock the file on the client's workers, to whom it can't be sent."""
    with client.as_current():
        write(dataset(whole), tmp_path / "whole.nc", "netcdf")
    assert (tmp_path / "whole.nc").stat().st_size > 0
