"""What a Dask worker does for a run: it gets ready, computes blocks and stages their files.

Everything here runs in the process of a worker and needs no Dask.
"""

import os
import secrets
import signal
import threading
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import fic_jax
from fic_jax.lanes.mapping import usable_cores
from sweeps import runner
from sweeps.provenance import IDENTITY, provenance, unlike
from sweeps.spec.mistakes import SweepError
from sweeps.store.commit import Writer
from sweeps.store.fsync import PARTIAL
from sweeps.store.ledger import SET_ASIDE, Row
from sweeps.store.opening import open_store

# Besides the identity of a store: workers and the process that runs the sweep exchange objects.
COMPARED = ("fic_jax", *IDENTITY)
_ONE_AT_A_TIME = threading.Lock()  # a worker may have several threads; a block uses all its cores


@dataclass(frozen=True)
class Job:
    """A run, as its workers must know it."""

    store: str  # an absolute path
    probe: str  # the name of a file in it, and its content
    made_by: tuple[tuple[str, str | int], ...]  # the provenance of the store
    sharing: int = 1  # workers that share its cores


@dataclass(frozen=True)
class Receipt:
    """A block that was computed, or (SET_ASIDE in its row) could not be."""

    row: Row
    suffix: str = ""  # of the partial names of its files


@dataclass(frozen=True)
class Unready:
    """The answer of a worker that can't compute the blocks of a run."""

    why: str


def compute(job: Job, index: int, known: Row | None, attempt: int) -> Receipt | Unready | OSError:
    """Compute a block and stage its files, under names that no other attempt has.

    Returns, instead of raising, what the file system refuses: Dask raises OSErrors of its own.
    """
    if problem := unready(job):
        return Unready(problem)
    writer = _writer(job)
    with _ONE_AT_A_TIME:
        values, row = runner.compute(writer.store, index, known, attempt)
        if row.outcome == SET_ASIDE:
            return Receipt(row)
        suffix = f".{secrets.token_hex(4)}{PARTIAL}"
        try:
            return Receipt(writer.stage(values, row, suffix), suffix)
        except OSError as error:
            return error


@lru_cache(maxsize=8)
def unready(job: Job) -> str:
    """Make this process ready for a run; why it can't be, or an empty text."""
    probe = Path(job.store, job.probe)
    try:
        if probe.read_text(encoding="utf-8") != job.probe:
            return f"sees another folder as {job.store}"
        own = probe.with_name(f"{job.probe}.{secrets.token_hex(4)}{PARTIAL}")
        own.touch()
        own.unlink()
    except OSError as error:
        return f"can't use the folder {job.store}: {error.strerror}"
    made_by = dict(job.made_by)
    precision = int(str(made_by["dtype"]).removeprefix("float"))
    try:
        _start_jax(str(made_by["platform"]), str(made_by["xla_flags"]), job.sharing)
        mine = provenance(precision)
    except SweepError as error:
        return str(error)
    return "; ".join(f"its {what}" for what in unlike(COMPARED, mine, made_by))


def _start_jax(platform: str, xla_flags: str, sharing: int) -> None:
    """Set JAX up as the store needs it, as far as it has not started for somebody else."""
    before = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = xla_flags
    try:
        runner.prepare(platform, max(len(usable_cores()) // sharing, 1))
    except RuntimeError:  # it has started, with the flags that were there
        os.environ["XLA_FLAGS"] = before


@lru_cache(maxsize=8)
def _writer(job: Job) -> Writer:
    return Writer(open_store(Path(job.store)))


def dask_setup(_worker: object) -> None:
    """Dask calls this when a worker of this machine starts: Ctrl-C stops the run, not its workers.

    Imported by then: jax, so that the first block does not wait for it.
    """
    assert fic_jax.NUMERICS
    signal.signal(signal.SIGINT, signal.SIG_IGN)
