"""Starts JAX, or says in one line which variable of the environment keeps it from starting."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax

from fic_jax.engine.tuning import CPU_FLAGS
from sweeps.spec.mistakes import SweepError

PLATFORM = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")
_PARSE = "from jaxlib import xla_client; xla_client.CompileOptions()"  # reads XLA_FLAGS


def check_xla_flags() -> None:
    """Raise SweepError for XLA_FLAGS that XLA refuses: it would end the process, with a dump.

    Another process tries them, in 0.2 s, unless they are ours. A file of flags is read, as XLA
    does, so that others can be added to them.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if set(flags.split()) <= set(CPU_FLAGS):
        return
    tried = subprocess.run(
        [sys.executable, "-c", _PARSE],
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        check=False,
    )
    said = re.search(r"^[EF]\d+ .*flags.*?\] (.+)$", tried.stderr, re.MULTILINE)
    if tried.returncode and said:
        raise SweepError(f"XLA_FLAGS={flags}: XLA refuses it: {said[1]}")
    if os.path.isfile(flags):
        os.environ["XLA_FLAGS"] = " ".join(Path(flags).read_text(encoding="utf-8").split())


def start(device: str | None) -> None:
    """Start JAX on "cpu", "gpu" or, with None, its own choice. Raises SweepError if it can't."""
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    try:
        jax.devices(device)
    # AssertionError: JAX_PLATFORMS=cuda where JAX has no plugin for CUDA
    except (RuntimeError, AssertionError, ValueError) as error:
        allowed = jax.config.jax_platforms  # type: ignore[attr-defined]
        names = [f"{n}={os.environ[n]}" for n in PLATFORM if os.environ.get(n)]
        variables = " ".join(names) or f"JAX_PLATFORMS={allowed}"
        finds = f"JAX {jax.__version__} finds no {device or 'such device'} here"
        if (allowed or names) and device != "cpu":
            why = f"{variables}: {finds}; unset the variable, or change it"
        elif device and device != "cpu":
            why = f"{finds}; a GPU needs a driver and `pip install 'jax[cuda13]'`"
        else:
            why = f"JAX {jax.__version__} can't start: {' '.join(str(error).split())}"
        raise SweepError(why) from None
