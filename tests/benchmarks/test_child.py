"""The protocol between a benchmark and the processes that it starts."""

import os
import select
import signal
import subprocess
import sys

import pytest

from benchmarks.child import BenchError, Child, Missing


def test_a_child_answers_call_after_call():
    with Child() as child:
        assert child.call("json.dumps", obj=[1, None]) == "[1, null]"
        assert child.call("builtins.print", end="not an answer\n") is None
        with pytest.raises(Missing, match="nothing_of_that_name is not installed"):
            child.call("benchmarks.peers.installed", module="nothing_of_that_name")
        assert child.call("json.loads", s="[1]") == [1]
        child.end()


def test_an_error_of_a_child_is_one_line():
    with Child() as child:
        with pytest.raises(BenchError, match=r"^json\.decoder\.JSONDecodeError: Expecting value"):
            child.call("json.loads", s="")
        with pytest.raises(BenchError):
            child.call("json.loads", s="1")


def test_a_child_imports_nothing_from_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "json.py").write_text("raise ImportError")
    monkeypatch.chdir(tmp_path)
    with Child() as child:
        assert child.call("os.getcwd") == str(tmp_path)


def test_an_interruption_kills_the_child():
    with pytest.raises(KeyboardInterrupt), Child() as child:
        raise KeyboardInterrupt
    assert child._process.returncode == -signal.SIGKILL


def test_a_child_exits_with_its_parent(tmp_path):
    """The child holds one end of a FIFO, thus the other end reads as empty once it has exited."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    code = f"""
import os
from benchmarks.child import Child
with Child() as child:
    child.call("os.open", path={str(fifo)!r}, flags=os.O_WRONLY)
    print("open", flush=True)
    child.call("signal.pause")
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as parent:
        assert parent.stdout.readline() == b"open\n"
        assert not select.select([reader], [], [], 0)[0]
        parent.kill()
        assert select.select([reader], [], [], 300)[0]  # a limit for a child that stays
        assert os.read(reader, 1) == b""
    os.close(reader)


def test_a_timed_process_imports_no_jax_before_its_start():
    code = "import sys, benchmarks.fic_sweep; assert not {'jax', 'numpy', 'typer'} & {*sys.modules}"
    subprocess.run([sys.executable, "-c", code], check=True)
