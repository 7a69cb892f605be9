"""A whole `fic-sweep` process, as its users start it, that ends with whoever started it.

Arguments: a file for a report or "-", the monotonic time of the start, and those of `fic-sweep`.
The report says how long starting (interpreter and imports) and compiling took.
"""

import json
import os
import sys
import threading
import time
from pathlib import Path


def main() -> None:
    """Be `fic-sweep`."""
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    report, began, *arguments = sys.argv[1:]
    sys.argv = ["fic-sweep", *arguments]
    if report == "-":
        from sweeps.cli import main as fic_sweep

        fic_sweep()
    else:
        _with_report(Path(report), float(began))


def _end_with_stdin() -> None:
    os.read(0, 1)
    os._exit(1)


def _with_report(report: Path, began: float) -> None:
    """Import what `run` imports later, then run, listening to JAX."""
    from sweeps.cli import main as fic_sweep
    from sweeps.cli.process import importing

    with importing():
        import jax

        import sweeps.runner  # noqa: F401  imported here to be timed

    spans: list[tuple[float, float]] = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith(("/jax/core/compile/", "/fic_jax/compile/")):
            now = time.monotonic()
            spans.append((now - duration_secs, now))

    jax.monitoring.register_event_duration_secs_listener(listen)
    start = time.monotonic() - began
    try:
        fic_sweep()
    finally:
        told = {"start_s": start, "compile_s": _covered(spans)}
        report.write_text(json.dumps(told), encoding="utf-8")


def _covered(spans: list[tuple[float, float]]) -> float:
    """Seconds inside any of the spans: tracing one function may contain tracing another."""
    total, end = 0.0, float("-inf")
    for start, stop in sorted(spans):
        total += max(stop - max(start, end), 0.0)
        end = max(end, stop)
    return total


if __name__ == "__main__":
    main()
