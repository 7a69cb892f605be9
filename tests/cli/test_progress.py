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
