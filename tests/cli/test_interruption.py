"""Ctrl-C and SIGTERM: finished blocks stay, and `resume` ends with the bits of an undisturbed run.

The signal comes from inside the run, at a chosen place, so that neither load nor luck decides.
"""

import re
import shlex
import signal
import subprocess
import sys

import pytest
import xarray as xr

from sweeps.cli import interruption
from tests.command import call, typed

RUN = """
import os, sys
from itertools import count

import jax

from sweeps import cli
from sweeps.store.commit import Writer

where, *signals = sys.argv[1:]
calls = count()


def send_signals():
    if next(calls) == 0:
        for signum in signals:
            os.kill(os.getpid(), int(signum))


if where == "compiling":  # JAX calls the listener while it traces and compiles the first block
    jax.monitoring.register_event_duration_secs_listener(lambda *_, **__: send_signals())
else:
    commit = Writer.commit

    def commit_and_send(*arguments):
        row = commit(*arguments)
        send_signals()
        return row

    Writer.commit = commit_and_send
sys.argv[1:] = ["run", "tiny.toml", "--chunk", "1"]
cli.main()
"""
BLOCKS = 12  # of one cell each
KEPT = (
    rf"fic-sweep: interrupted; (\d+) of {BLOCKS} scenarios are kept, "
    r"`fic-sweep resume tiny.zarr` does the rest"
)


@pytest.mark.parametrize(
    ("where", "signals"),
    [
        ("compiling", [signal.SIGINT]),
        ("committing", [signal.SIGTERM]),
        ("committing", [signal.SIGHUP]),
        ("committing", [signal.SIGINT, signal.SIGTERM]),
    ],
)
def test_an_interrupted_run_keeps_its_blocks_and_resume_does_the_rest(
    folder, first_run, where, signals
):
    ended = subprocess.run(
        [sys.executable, "-c", RUN, where, *map(str, map(int, signals))],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1, ended.stderr
    stopping, *last = ended.stderr.splitlines()
    assert stopping == "fic-sweep: stopping after this block; a second signal stops at once"
    if len(signals) == 1:
        kept = int(re.fullmatch(KEPT, *last)[1])
        assert (0 if where == "compiling" else 1) <= kept < BLOCKS
    else:
        assert last == []
    assert ended.stdout == ""
    resumed = call("resume", "tiny.zarr", code=0, folder=folder).stdout
    ran = int(re.match(r"tiny\.zarr: (\d+) scenarios? in", resumed)[1])
    if len(signals) == 1:
        assert ran == BLOCKS - kept
    assert 0 < ran <= BLOCKS
    with (
        xr.open_zarr(folder / "tiny.zarr") as one,
        xr.open_zarr(first_run[0] / "tiny.zarr") as other,
    ):
        xr.testing.assert_equal(one, other)


def test_a_stop_during_the_last_block_completes_the_run(folder, monkeypatch):
    class StopAtEleven(interruption.Stop):
        def after_block(self, progress):
            self.requested = progress.done == BLOCKS - 1
            super().after_block(progress)

    monkeypatch.setattr(interruption, "Stop", StopAtEleven)
    ended = typed("run", "tiny.toml", "--chunk", "1")
    assert (ended.code, ended.stderr) == (0, "")
    assert ended.stdout == "tiny.zarr: complete already, 12 scenarios\n"
    assert re.search(r"ended 20\d\d-", typed("status", "tiny.zarr").stdout)


def test_the_command_that_an_interrupted_run_prints_works_when_pasted(folder, monkeypatch):
    stopped = interruption.Stop(requested=True)
    with monkeypatch.context() as patch:
        patch.setattr(interruption, "Stop", lambda: stopped)
        ended = typed("run", "tiny.toml", "--out", "my store.zarr")
    assert ended.code == 1
    command = re.search("`fic-sweep (.*)` does the rest", ended.stderr)[1]
    resumed = typed(*shlex.split(command))
    assert (resumed.code, resumed.stderr) == (0, "")
    assert resumed.stdout.startswith("my store.zarr: 12 scenarios in ")
