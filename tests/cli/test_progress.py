"""A line now and then in a log, a bar on a terminal."""

import io
import math
import sys

import pytest

from sweeps import runner
from sweeps.cli import progress
from sweeps.cli.interruption import Stop
from sweeps.spec.reading import load
from tests.command import typed


@pytest.mark.parametrize(("interval", "lines"), [(0.0, 12), (math.inf, 0)])
def test_a_log_gets_a_line_for_each_interval(folder, monkeypatch, interval, lines):
    monkeypatch.setattr(progress, "LOG_INTERVAL", interval)
    *log, summary = typed("run", "tiny.toml", "--chunk", "1").stdout.splitlines()
    assert summary.startswith("tiny.zarr: 12 scenarios in ")
    assert len(log) == lines
    if log:
        assert log[0].startswith("1 of 12 (8.333 %) ")
        assert log[-1].endswith(" scenarios/s, 0.0 s left")
    assert "\x1b" not in summary


@pytest.mark.parametrize("interval", [0.0, math.inf])
def test_merge_and_reduce_count_their_blocks_in_a_log(folder, monkeypatch, interval):
    for k in (1, 2):
        assert typed("run", "tiny.toml", "--chunk", "3", "--shard", f"{k}/2").code == 0
    monkeypatch.setattr(progress, "LOG_INTERVAL", interval)
    merge = ("merge", "tiny.1-of-2.zarr", "tiny.2-of-2.zarr")
    reduce = ("reduce", "tiny.zarr", "--over", "Td", "--max", "nmse", "--chunk", "1")
    for words, blocks in ((merge, 8), (reduce, 4)):
        log = [line for line in typed(*words).stdout.splitlines() if line.endswith(" blocks")]
        counts = [f"{done} of {blocks} blocks" for done in range(1, blocks + 1)]
        assert log == ([] if interval else counts)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_gets_a_bar_that_leaves_no_trace(folder, monkeypatch):
    store = runner.start(folder / "tiny.zarr", load(folder / "tiny.toml"), 2, 32)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    for name, value in {"TERM": "xterm", "COLUMNS": "80"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("TTY_COMPATIBLE", raising=False)
    assert progress.run_with_progress(store, Stop()).ran == 12
    drawn = terminal.getvalue()
    assert "tiny" in drawn
    assert "0 % compiling" in drawn
    assert "100 %" in drawn
    assert drawn.endswith("\x1b[2K")  # the line is erased
    with progress.blocks_counted("merge") as show:
        show(3, 8)
    assert "merge" in terminal.getvalue()
    assert "3/8\x1b[0m blocks" in terminal.getvalue()
