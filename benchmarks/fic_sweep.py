"""One `fic-sweep` process, as its users start it. It imports nothing before its start is timed."""

import os
import sys
import time
from typing import Any

from benchmarks.child import Child

RSS_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes, of ru_maxrss


def timed(*arguments: str, cache: str, report: bool = False) -> dict[str, Any]:
    """Run `fic-sweep` from the start of its process to its end: {"seconds", "peak_bytes"}.

    `cache` is the folder of its compile cache. With `report` also {"start_s", "compile_s"}: the
    interpreter and imports; tracing, LLVM and XLA. Raises BenchError unless it exits with 0.
    """
    began = time.monotonic()
    with Child() as child:
        answer = child.call(
            "benchmarks.fic_sweep.run", arguments=arguments, cache=cache, began=began, report=report
        )
        child.end()
        return answer | {"seconds": time.monotonic() - began}


def run(arguments: list[str], cache: str, began: float, report: bool) -> dict[str, Any]:
    """Called in a child: be `fic-sweep`, up to its exit."""
    from resource import RUSAGE_SELF, getrusage

    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    os.environ["FIC_SWEEP_CACHE"] = cache
    sys.argv = ["fic-sweep", *arguments]
    from sweeps.cli import main
    from sweeps.cli.process import importing

    spans: list[tuple[float, float]] = []
    answer = {}
    if report:
        with importing():
            import jax

            import sweeps.runner  # noqa: F401  the command imports it later: here it is timed

        def listen(event: str, duration_secs: float, **_: str | int) -> None:
            if event.startswith(("/jax/core/compile/", "/fic_jax/compile/")):
                now = time.monotonic()
                spans.append((now - duration_secs, now))

        jax.monitoring.register_event_duration_secs_listener(listen)
        answer["start_s"] = time.monotonic() - began
    try:
        main()
    except SystemExit as stop:
        if stop.code:
            raise
    if report:
        answer["compile_s"] = covered(spans)
    return answer | {"peak_bytes": getrusage(RUSAGE_SELF).ru_maxrss * RSS_UNIT}


def covered(spans: list[tuple[float, float]]) -> float:
    """Seconds inside any span: tracing a function may include tracing another."""
    total, end = 0.0, float("-inf")
    for start, stop in sorted(spans):
        total += max(stop - max(start, end), 0.0)
        end = max(end, stop)
    return total
