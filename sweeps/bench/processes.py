"""The parent's side: children that are asked in turn, and whole processes that are timed."""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

# -P: nothing is imported from the folder the user happens to stand in. A session of its own: Ctrl-C
# reaches the parent alone, which ends its children without a traceback of theirs.
PYTHON = (sys.executable, "-P", "-m")
RSS_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes, of ru_maxrss


class BenchError(Exception):
    """What could not be measured, in one line."""


class Child:
    """One arrangement in a process that stays alive until the end of a `with`.

    `missing` says why it can't be measured, if so; `sizes` what it can be asked for.
    """

    def __init__(self, kind: str, steps: int, **what: Any) -> None:
        self._errors: IO[str] = tempfile.TemporaryFile("w+")  # noqa: SIM115  closed by __exit__
        self._process = subprocess.Popen(
            [*PYTHON, "sweeps.bench.child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            start_new_session=True,
        )
        self._setting = {"kind": kind, "steps": steps, **what}
        self.missing: str | None = None
        self.sizes: list[int] = []
        self.first_s = 0.0

    def __enter__(self) -> Self:
        try:
            self._set_up()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.communicate()
        self._errors.close()

    def seconds(self, size: int) -> float:
        """One timed run. Raises BenchError if the child ended in it."""
        return float(self._ask(size))

    def _set_up(self) -> None:
        answer = json.loads(self._ask(self._setting))
        self.missing = answer.get("missing")
        if self.missing is None:
            self.sizes, self.first_s = answer["sizes"], answer["first_s"]

    def _ask(self, line: Any) -> str:
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin and stdout
        try:
            stdin.write(json.dumps(line) + "\n")
            stdin.flush()
            answer = stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            raise BenchError(f"its process ended: {_last_line(self._errors)}")
        return answer


@dataclass(frozen=True)
class Whole:
    """A process from its start to its end."""

    seconds: float
    peak_bytes: int  # the most memory it had at once
    start_s: float = 0.0  # interpreter and imports
    compile_s: float = 0.0  # tracing, LLVM or XLA


def whole(folder: Path, *arguments: str, cache: Path, report: bool = False) -> Whole:
    """Run `fic-sweep` in a folder; with `report` also ask it where its time went.

    `cache` is where it keeps its compiled programs, and the only such place it knows.

    Raises BenchError unless it ends with 0.
    """
    known = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    told = folder / "report.json"
    began = time.monotonic()
    command = [*PYTHON, "sweeps.bench.whole", str(told) if report else "-", str(began)]
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            [*command, *arguments],
            cwd=folder,
            env=known | {"FIC_SWEEP_CACHE": str(cache)},
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
        ) as process,
    ):
        try:
            _, status, usage = os.wait4(process.pid, 0)  # its own peak, not that of all children
            seconds = time.monotonic() - began
            process.returncode = os.waitstatus_to_exitcode(status)
        except BaseException:
            process.kill()
            raise
        if process.returncode:
            call = " ".join(["fic-sweep", *arguments])
            raise BenchError(f"`{call}` failed: {_last_line(errors)}")
    times = json.loads(told.read_text(encoding="utf-8")) if report else {}
    return Whole(seconds, usage.ru_maxrss * RSS_UNIT, **times)


def _last_line(errors: IO[str]) -> str:
    """What a process ended with: its error, or else its last words."""
    errors.seek(0)
    lines = errors.read().strip().splitlines() or ["without a word"]
    named = [line for line in lines if re.match(r"[\w.]+(Error|Exception|Interrupt)\b", line)]
    return (named or lines)[-1]
