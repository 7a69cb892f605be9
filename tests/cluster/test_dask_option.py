"""`--dask` as a user types it: the same store, signals, kills, and what is refused."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest
import xarray as xr

from sweeps.store.opening import Counts, open_store
from tests.cluster import sabotage
from tests.cluster.conftest import BLOCKS, TEXT
from tests.command import FIC_SWEEP, typed
from tests.torture import TORTURE


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with many.toml; Dask's workers take their time (`slow`)."""
    (tmp_path / "many.toml").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def started(folder, *arguments):
    """The command in a process group of its own, as a terminal starts it; its workers are slow."""
    (folder / "slow").write_text("0.3")
    # the workers of `--dask local:N` load sweeps.worker, and with it the sabotage
    code = (
        "import sys, sweeps.cluster as c, sweeps.cli as cli\n"
        "import distributed, functools\n"
        "if __name__ == '__main__':\n"
        "    whole = distributed.LocalCluster\n"
        "    distributed.LocalCluster = lambda **k: whole(**k | {'preload': [*k['preload'], "
        f"{os.path.abspath(sabotage.__file__)!r}]}})\n"
        "    cli.main()\n"
    )
    (folder / "main.py").write_text(code)
    return subprocess.Popen(
        [sys.executable, "main.py", *arguments],
        env=os.environ | {sabotage.VARIABLE: str(folder), "PYTHONUTF8": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8",
        start_new_session=True,
    )  # fmt: skip


def wait_for_blocks(path, n):
    for _ in range(600):
        time.sleep(0.1)
        if (path / "ledger.sqlite").exists() and Counts.of(open_store(path)).done >= n:
            return
    raise AssertionError("no block was done in a minute")


def test_ctrl_c_then_the_rest(folder, whole):
    """The store ends as that of a run in one process. In the torture test the driver is killed."""
    pytest.importorskip("distributed", reason="needs the extra `dask`")
    path = folder / "many.zarr"
    arguments = ("run", "many.toml", "--chunk", "1", "--dask", "local:2")
    with started(folder, *arguments) as process:
        wait_for_blocks(path, 2)
        os.killpg(process.pid, signal.SIGINT)  # the terminal sends it to the workers too
        _, err = process.communicate(timeout=60)
    assert process.returncode == 1, err
    stopping, last = (line for line in err.splitlines() if "dashboard" not in line)
    assert stopping == "fic-sweep: stopping after this block; a second signal stops at once"
    kept = int(
        re.search(r"interrupted; (\d+) of 18 scenarios are kept, `fic-sweep resume", last)[1]
    )
    assert 2 <= kept < BLOCKS
    if TORTURE:
        with started(folder, "resume", "many.zarr", "--dask", "local:2") as process:
            wait_for_blocks(path, kept + 2)
            process.kill()
            process.communicate(timeout=60)
        again = Counts.of(open_store(path)).done
        assert kept + 2 <= again < BLOCKS
        kept = again
    done = subprocess.run(
        [FIC_SWEEP, "resume", "many.zarr", "--dask", "local:1"],
        capture_output=True, encoding="utf-8", check=True,
    )  # fmt: skip
    assert not [line for line in done.stderr.splitlines() if "dashboard" not in line]
    assert done.stdout.startswith(f"many.zarr: {BLOCKS - kept} scenarios in ")
    assert typed("verify", "many.zarr").code == 0
    rows = [[row.files for row in open_store(store).rows()] for store in (path, whole)]
    assert rows[0] == rows[1]
    with xr.open_zarr(path) as data:
        assert (data["status"] == 1).all()


def test_a_dead_address_is_refused_before_anything_is_written(folder, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra `dask`")
    monkeypatch.setattr("sweeps.cluster.CONNECT", 0.5)
    ended = typed("run", "many.toml", "--dask", "tcp://127.0.0.1:9")
    assert (ended.code, ended.stdout) == (2, "")
    assert re.fullmatch(
        r"fic-sweep: --dask tcp://127\.0\.0\.1:9: no scheduler answers: .*\n", ended.stderr
    )
    assert not (folder / "many.zarr").exists()


def test_without_dask(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    ended = typed("run", "many.toml", "--dask", "local:2")
    assert ended.code == 2
    assert "needs distributed" in ended.stderr
    assert "`pip install 'fic-jax[dask]'` installs it\n" in ended.stderr
    assert not (folder / "many.zarr").exists()


@pytest.mark.parametrize("place", ["local:0", "cluster", "tcp://host"])
def test_a_place_that_is_none(folder, place):
    ended = typed("run", "many.toml", "--dask", place)
    assert ended.code == 2
    assert ended.stderr == (
        f"fic-sweep: --dask {place}: must be local:N with N workers of this machine, "
        "or a scheduler such as tcp://host:8786\n"
    )
