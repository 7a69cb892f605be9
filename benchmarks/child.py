"""Call functions in a fresh process: JAX reads its flags and its devices once in a process.

The parent writes one JSON line per call, {"function": "package.module.name", "arguments": {}}. The
child answers with one line, {"value": ...}, or {"missing": why} if the function raises Missing.
The line `null` lets the child exit as a program does. When its stdin ends, the child exits at once,
also during a computation: no child outlives its parent.

The start of a child is part of some timings, so this file imports only light modules.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
from queue import SimpleQueue
from typing import IO, Any, Self


class Missing(Exception):  # noqa: N818  not an error: the rest can still be measured
    """Why something can't be measured on this machine, in one line."""


class BenchError(Exception):
    """Why a benchmark failed, in one line."""


class Child:
    """A process that calls functions for its parent; it is killed at the end of the `with`."""

    def __enter__(self) -> Self:
        # -P: the child imports nothing from the current folder. In its own session, it gets no
        # Ctrl-C: the parent alone gets it, and kills the child, which then prints no traceback.
        self._errors: IO[str] = tempfile.TemporaryFile("w+")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", "from benchmarks.child import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            start_new_session=True,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._errors.close()

    def call(self, function: str, **arguments: Any) -> Any:
        """What the function returns. Raises Missing with it, and BenchError if the child exits."""
        line = self._ask({"function": function, "arguments": arguments})
        if not line:
            raise BenchError(self._last_line())
        answer = json.loads(line)
        if "missing" in answer:
            raise Missing(answer["missing"])
        return answer["value"]

    def stop(self) -> None:
        """Kill the process, from any thread; the call that waits for it raises BenchError."""
        self._process.kill()

    def end(self) -> None:
        """Let the child exit as a program does, and wait for that."""
        self._ask(None)
        self._process.wait()

    def _ask(self, line: object) -> str:
        """The child's next line; empty if the child has exited."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin and stdout
        try:
            stdin.write(json.dumps(line) + "\n")
            stdin.flush()
        except BrokenPipeError:
            return ""
        return stdout.readline()

    def _last_line(self) -> str:
        """The error that ended the child, or else the last line that it printed."""
        self._errors.seek(0)
        lines = self._errors.read().strip().splitlines() or ["a process ended without a message"]
        errors = [line for line in lines if re.match(r"[\w.]+(Error|Exception|Interrupt)\b", line)]
        return (errors or lines)[-1]


def serve() -> None:
    """The child's side: answer until the line `null`."""
    from importlib import import_module

    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a library prints is not an answer
    lines: SimpleQueue[str] = SimpleQueue()
    threading.Thread(target=_read, args=(lines,), daemon=True).start()
    while (call := json.loads(lines.get())) is not None:
        module, _, name = call["function"].rpartition(".")
        try:
            value = getattr(import_module(module), name)(**call["arguments"])
            answer = {"value": value}
        except Missing as why:
            answer = {"missing": str(why)}
        answers.write(json.dumps(answer) + "\n")


def _read(lines: "SimpleQueue[str]") -> None:
    """Pass stdin on line by line; exit the process when it ends."""
    with open(0, closefd=False) as stdin:  # sys.stdin's lock would disturb the interpreter's exit
        for line in stdin:
            lines.put(line)
    os._exit(1)
