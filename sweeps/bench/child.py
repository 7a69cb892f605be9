"""One arrangement in a process of its own, asked line by line over stdin; answers on stdout.

The first line sets it up, {"kind", "steps", and "sizes" or "file"}; the answer is what there is,
{"sizes", "first_s"}, or {"missing": why}. Each line after it is a size, answered by the seconds a
run of it took. The process ends with its stdin, thus with whoever started it.
"""

import json
import os
import sys
import threading
import time
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import jax

from fic_jax import Params
from sweeps.bench.arrangements import (
    Missing,
    configure,
    in_precision,
    planned,
    prepare,
    scenarios,
)


def main() -> None:
    """Answer until stdin ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # whatever a library prints is no answer
    asked: SimpleQueue[str] = SimpleQueue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    runs: dict[int, Any] = {}
    try:
        runs, answer = _set_up(**json.loads(asked.get()))
    except Missing as error:
        answer = {"missing": str(error)}
    answers.write(json.dumps(answer) + "\n")
    while True:
        answers.write(f"{_timed(runs[int(asked.get())])}\n")


def _listen(asked: "SimpleQueue[str]") -> None:
    """Pass lines on; at their end stop at once, also in the middle of a computation."""
    for line in sys.stdin:
        asked.put(line)
    os._exit(0)


def _set_up(
    kind: str, steps: int, sizes: list[int] | None = None, file: str | None = None
) -> tuple[dict[int, Any], dict[str, Any]]:
    """A run for each size, compiled with the least of them."""
    configure(kind)
    batch = in_precision(planned(Path(file)) if file else scenarios(max(sizes or [])), kind)
    whole = max(leaf.size for leaf in jax.tree.leaves(batch))
    runs = {}
    began = time.perf_counter()
    for n in sizes or [whole]:
        runs[n] = prepare(kind, _first(batch, n), steps)
    runs[min(runs)]()
    return runs, {"sizes": list(runs), "first_s": time.perf_counter() - began}


def _first(batch: Params, n: int) -> Params:
    return jax.tree.map(lambda leaf: leaf[:n] if leaf.ndim else leaf, batch)


def _timed(run: Any) -> float:
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
