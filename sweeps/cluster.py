"""Run the blocks of a store on the workers of a Dask client (`sweeps.worker` is their part).

A block is a task for one worker. The worker stages the block's files; this process alone gives them
their names and inserts the row, so that a worker that computes a block twice, or late, changes no
finished block. This process also decides who computes what, and so knows which blocks a dead worker
had. These run again after all others, each alone on a worker: a block that kills its worker then
takes no other one with it.
"""

import logging
import os
import queue
import re
import secrets
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, TypeAlias

from fic_jax.lanes.mapping import usable_cores
from sweeps import worker
from sweeps.provenance import provenance
from sweeps.runner import ATTEMPTS, Committed, set_aside
from sweeps.spec.mistakes import SweepError, printable
from sweeps.spec.types import Sweep
from sweeps.store.commit import Writer, delete_partials
from sweeps.store.fsync import PARTIAL
from sweeps.store.ledger import SET_ASIDE, Row
from sweeps.store.lock import Lock
from sweeps.store.opening import Store

if TYPE_CHECKING:
    from distributed import Client, Future

    Answer: TypeAlias = Future[worker.Receipt | worker.Unready | OSError]

WINDOW = 3  # tasks of a worker, so that it does not wait for this process
LOOK = 0.5  # s between two looks at who is there
CONNECT = 5.0  # s for a scheduler to answer
READY = 60.0  # s for a worker to see the store and start JAX
WORKERS = 60.0  # s without a worker that can compute, before a run ends
# A block that takes longer than this hangs: many times the slowest one that has ended, because
# blocks of other scenarios may take longer; and time to compile another model.
HANG_FACTOR, HANG_LEAST, HANG_FIRST = 20, 120.0, 3600.0  # 1, s, s before any block has ended
_LOCAL = re.compile(r"local:(\d{1,4})", re.ASCII)
_ADDRESS = re.compile(r"[a-z]+://\S+:\d{1,5}", re.ASCII)


def check_place(place: str) -> int:
    """Workers of "local:N", or 0 for a scheduler's address. Raises SweepError for another text."""
    local = _LOCAL.fullmatch(place)
    if local and int(local[1]):
        return int(local[1])
    if local or not _ADDRESS.fullmatch(place):
        wanted = "local:N with N workers of this machine, or a scheduler such as tcp://host:8786"
        raise SweepError(f"--dask {printable(place)}: must be {wanted}")
    return 0


def refuse_refined(sweep: Sweep) -> None:
    """Raise SweepError for a refined sweep: which cells it needs, its process alone knows."""
    if sweep.refine:
        why = "is refined, and each round needs the values of all cells; run it without a cluster"
        raise SweepError(f"{sweep.name}: {why}")


@contextmanager
def connected(place: str) -> Iterator["Client"]:
    """A client of the scheduler at an address, or of "local:N" new workers of this machine.

    Raises SweepError if `place` is neither, if nothing answers there, or without Dask.
    """
    n = check_place(place)
    try:
        import dask.config
        import distributed
    except ImportError as error:
        install = "`pip install 'fic-jax[dask]'` installs it"
        raise SweepError(f"--dask {place}: needs distributed ({error}); {install}") from None
    for name in ("distributed", "distributed.client"):  # each has a level of its own
        logging.getLogger(name).setLevel(logging.CRITICAL)  # we say it in a line ourselves
    # a table of packages that may not matter: a worker that can't compute is named, with its reason
    warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
    environment = {
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",  # workers may share a GPU
        "DASK_LOGGING__DISTRIBUTED": "critical",
        "PYTHONWARNINGS": "ignore",  # this process has the same, and shows each once
    }
    before = dask.config.get("distributed.nanny.pre-spawn-environ", {})
    settings: dict[str, Any] = {
        "distributed.nanny.pre-spawn-environ": before | environment,
        "distributed.comm.timeouts.connect": CONNECT,
        # a new process imports JAX in some seconds, on a busy machine in many
        "distributed.deploy.lost-worker-timeout": WORKERS,
    }
    with dask.config.set(settings):
        if not n:
            try:
                client = distributed.Client(place, timeout=CONNECT, set_as_default=False)
            except (OSError, ValueError) as error:
                why = printable(" ".join(str(error).split()))[:150]
                raise SweepError(f"--dask {place}: no scheduler answers: {why}") from None
            with client:
                yield client
            return
        with (
            distributed.LocalCluster(
                n_workers=n,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                memory_limit=0,  # the plan limits the size of a block
                silence_logs=logging.CRITICAL,
                preload=["sweeps.worker"],
            ) as cluster,
            distributed.Client(cluster, set_as_default=False) as client,
        ):
            yield client


def dashboard(client: "Client") -> str:
    """The address of a client's dashboard; empty if it has none (it needs bokeh)."""
    with suppress(Exception):  # an old scheduler, or one without a web server
        if client.cluster is None or find_spec("bokeh"):
            return str(client.dashboard_link or "")
    return ""


@dataclass(frozen=True)
class Task:
    """A block that is to be computed."""

    block: int
    attempt: int = 1
    deaths: int = 0  # of workers that had no other block
    suspect: bool = False  # a worker that had it has died

    def again(self) -> "Task":
        """The task after an attempt that failed."""
        return replace(self, attempt=self.attempt + 1)

    def after_death(self, alone: bool) -> "Task":
        """The task after the death of a worker that had it, perhaps `alone`."""
        return replace(self, suspect=True, deaths=self.deaths + alone)


@dataclass
class Hand:
    """A worker that computes blocks."""

    address: str
    job: worker.Job
    tasks: dict["Answer", Task] = field(default_factory=dict)
    since: float = 0.0  # when it began its first task
    new: bool = True  # a nanny does not restart a worker that dies while it is being started

    def free_for(self, task: Task) -> bool:
        """Whether it may get a task: a suspect is alone, and for no new worker."""
        if task.suspect or any(other.suspect for other in self.tasks.values()):
            return not self.tasks and not self.new
        return len(self.tasks) < WINDOW


@dataclass(frozen=True)
class Greeting:
    """What a worker answered that was to get ready."""

    address: str
    job: worker.Job
    answer: object  # an empty text if it is; else why not, or an exception


class Cluster:
    """The workers of a client, for one run of one store. `run_blocks` is for `runner.run`."""

    def __init__(self, client: "Client", store: Store) -> None:
        self.client, self.store = client, store
        self.hands: dict[str, Hand] = {}
        self.getting_ready: dict[str, float] = {}  # address -> since when
        self.refused: dict[str, str] = {}  # address -> why
        self.hung: set[str] = set()  # addresses of workers that were given up
        self.used = False  # whether a worker has been ready: others may come in its place
        self.cores: dict[str, frozenset[int]] = {}  # address -> cores of its host that it may use
        self.sharing: Counter[tuple[str, frozenset[int]]] = Counter()  # the most at a time
        self.counting = threading.Lock()  # workers get ready side by side
        self.slowest = 0.0  # s, of the blocks that have ended
        self.todo: deque[Task] = deque()
        self.suspects: deque[Task] = deque()
        self.arrived: queue.SimpleQueue[Answer | Greeting] = queue.SimpleQueue()
        self.failed: list[tuple[Task, str]] = []
        self.last_look = 0.0
        self.last_hand = time.monotonic()
        made_by = provenance(int(store.dtype.removeprefix("float")))
        made_by |= {key: value for key, value in store.group.attrs.asdict().items()
                    if key in worker.COMPARED and key != "fic_jax"}  # fmt: skip
        compared = tuple((key, made_by[key]) for key in worker.COMPARED)
        probe = f"probe-{secrets.token_hex(8)}{PARTIAL}"
        self.job = worker.Job(str(store.path.absolute()), probe, compared)

    def run_blocks(
        self, writer: Writer, lock: Lock, pending: list[int], unfinished: Mapping[int, Row]
    ) -> Generator[Committed]:
        """Compute and commit blocks; yields their rows, at least every LOOK seconds.

        Closing the generator commits what workers have finished. Raises SweepError if no worker
        can compute the sweep, OSError if all workers are lost or the disk refuses.
        """
        self.todo.extend(Task(block) for block in pending)
        probe = self.store.path / self.job.probe
        probe.write_text(self.job.probe, encoding="utf-8")
        try:
            while self.todo or self.suspects or any(hand.tasks for hand in self.hands.values()):
                self._look()
                self._hand_out(unfinished)
                rows = self._collect(writer, LOOK)
                rows += self._set_aside(writer, unfinished)
                yield rows, time.perf_counter()
        finally:
            with suppress(OSError):
                self._collect(writer, 0.0)
            flying = [future for hand in self.hands.values() for future in hand.tasks]
            with suppress(Exception):  # the scheduler may be gone
                self.client.cancel(flying)
            delete_partials(self.store.path)

    def _look(self) -> None:
        """See which workers have come, have gone or hang. Raises SweepError, OSError."""
        now = time.monotonic()
        if now - self.last_look < LOOK:
            return
        self.last_look = now
        try:
            present = set(self.client.nthreads()) - self.hung
        except Exception as error:  # whatever Dask raises for a lost connection
            why = printable(str(error).splitlines()[0] if str(error) else type(error).__name__)
            raise ConnectionError(f"the scheduler does not answer any more: {why}") from None
        for address in self.hands.keys() - present:
            self._lose(self.hands.pop(address))
        for address in self.getting_ready.keys() - present:
            del self.getting_ready[address]
        for address, since in list(self.getting_ready.items()):
            if now - since > READY:
                del self.getting_ready[address]
                self._refuse(address, f"it hangs: it is not ready after {READY:.0f} s")
        for hand in list(self.hands.values()):
            hand.new = False
            self._restart_if_hanging(hand, now)
        known = self.hands.keys() | self.getting_ready.keys() | self.refused.keys()
        self._welcome(sorted(present - known), present)
        self._replace_lost(len(present))
        patience = WORKERS + (READY if self.getting_ready else 0)
        if self.hands:
            self.last_hand = now
        elif present and not self.used and not present - self.refused.keys():
            whys = "; ".join(f"{address}: {self.refused[address]}" for address in sorted(present))
            raise SweepError(f"{self.store.path}: no worker can run it: {whys}")
        elif now - self.last_hand > patience:
            where = getattr(self.client.scheduler, "address", "the scheduler")
            usable = " that can run it" if present else ""
            raise ConnectionError(f"{where} has had no worker{usable} for {patience:.0f} s")

    def _replace_lost(self, present: int) -> None:
        """Start the workers of this machine again that Dask has given up."""
        cluster: Any = self.client.cluster
        if type(cluster).__name__ == "LocalCluster" and present < len(cluster.worker_spec):
            cluster.scale(len(cluster.worker_spec))

    def _welcome(self, new: list[str], present: set[str]) -> None:
        """Let new workers get ready, each in its time: one that hangs keeps nobody waiting."""
        for address in new:
            self.getting_ready[address] = time.monotonic()
            mates = {other for other in present if _host(other) == _host(address)} - {address}
            threading.Thread(target=self._greet, args=(address, mates), daemon=True).start()

    def _greet(self, address: str, mates: set[str]) -> None:
        """Let a worker get ready, and wait for its answer; `mates` are the others of its host."""
        job = self.job
        try:
            cores = self.client.run(usable_cores, workers=[address], on_error="return")
            mine = cores[address] if isinstance(cores[address], frozenset) else frozenset()
            self.cores[address] = mine
            job = replace(job, sharing=self._sharing(address, mine, mates))
            said = self.client.run(worker.unready, job, workers=[address], on_error="return")
            answer = said[address]
        except Exception as error:  # it has gone meanwhile, or the scheduler has
            answer = OSError(error)
        self.arrived.put(Greeting(address, job, answer))

    def _sharing(self, address: str, mine: frozenset[int], mates: set[str]) -> int:
        """Workers that share the cores of this one: a scheduler may give each its own.

        Waits for what the others of its host say, but not long: one may hang.
        """
        until = time.monotonic() + CONNECT
        while not mates <= self.cores.keys() and time.monotonic() < until:
            time.sleep(0.02)
        sharing = 1 + sum(bool(self.cores.get(mate, mine) & mine) for mate in mates)
        key = _host(address), mine
        with self.counting:
            # a mate may be about to come again
            self.sharing[key] = max(self.sharing[key], sharing)
            return self.sharing[key]

    def _judge(self, greeting: Greeting) -> None:
        """Use a worker that is ready; one that can't be is named in a warning and not used."""
        address, answer = greeting.address, greeting.answer
        if self.getting_ready.pop(address, None) is None:  # too late
            return
        if answer == "":
            self.hands[address] = Hand(address, greeting.job)
            self.used = True
        elif not isinstance(answer, OSError):  # that would be one that has gone
            # Dask turns what a worker could not read into a text
            missing = re.search(r"ModuleNotFoundError|ImportError|AttributeError", repr(answer))
            self._refuse(address, f"{'has no such fic-jax: ' if missing else ''}{answer}")

    def _refuse(self, address: str, why: str) -> None:
        self.refused[address] = why = printable(" ".join(why.split()))
        warnings.warn(f"worker {address} is not used: {why}", RuntimeWarning, stacklevel=1)

    def _lose(self, hand: Hand) -> None:
        """A worker has gone: what it had is suspect."""
        alone = len(hand.tasks) == 1
        for task in [task.after_death(alone) for task in hand.tasks.values()]:
            if task.deaths >= ATTEMPTS:
                self.failed.append((task, f"killed its worker {ATTEMPTS} times"))
            else:
                self.suspects.append(task)
        with suppress(Exception):
            self.client.cancel(list(hand.tasks))
        hand.tasks.clear()

    def _restart_if_hanging(self, hand: Hand, now: float) -> None:
        bound = max(HANG_FACTOR * self.slowest, HANG_LEAST) if self.slowest else HANG_FIRST
        if not hand.tasks or now - hand.since < bound:
            return
        block = next(iter(hand.tasks.values())).block
        self.hung.add(hand.address)
        why = f"hangs at block {block}, for {bound:.0f} s: it is restarted"
        warnings.warn(f"worker {hand.address} {why}", RuntimeWarning, stacklevel=1)
        self._lose(self.hands.pop(hand.address))
        # it takes long if the worker does not even hear
        threading.Thread(target=_restart, args=(self.client, hand.address), daemon=True).start()

    def _hand_out(self, unfinished: Mapping[int, Row]) -> None:
        """Give each worker tasks, the one with the fewest first; suspects come last."""
        while tasks := self.todo or self.suspects:
            free = [hand for hand in self.hands.values() if hand.free_for(tasks[0])]
            if not free:
                return
            hand, task = min(free, key=lambda hand: len(hand.tasks)), tasks.popleft()
            future = self.client.submit(
                worker.compute, hand.job, task.block, unfinished.get(task.block), task.attempt,
                workers=[hand.address], allow_other_workers=False, pure=False,
                key=f"block-{task.block}-{secrets.token_hex(8)}",
            )  # fmt: skip
            if not hand.tasks:
                hand.since = time.monotonic()
            hand.tasks[future] = task
            future.add_done_callback(self.arrived.put)

    def _collect(self, writer: Writer, seconds: float) -> list[Row]:
        """Commit the blocks that have arrived, and judge greetings; waits so long for the first.

        Raises OSError.
        """
        rows = []
        with suppress(queue.Empty):
            arrived = self.arrived.get(timeout=seconds) if seconds else self.arrived.get_nowait()
            while True:
                if isinstance(arrived, Greeting):
                    self._judge(arrived)
                else:
                    rows += self._receive(writer, arrived)
                arrived = self.arrived.get_nowait()
        return rows

    def _receive(self, writer: Writer, future: "Answer") -> list[Row]:
        """Commit the block of a future that has ended; its row, if it has one."""
        hand = next((hand for hand in self.hands.values() if future in hand.tasks), None)
        if hand is None:  # of a worker that was given up
            return []
        try:
            answer = future.result(timeout=CONNECT)
        except Exception as error:  # the worker died, or could not even read the task
            if future.status == "error" and not _of_dask(error):
                answer = worker.Unready(f"can't compute: {error}")
            else:
                self._lose(self.hands.pop(hand.address))
                return []
        task = hand.tasks.pop(future)
        hand.since = time.monotonic()
        if isinstance(answer, OSError):
            raise answer
        if isinstance(answer, worker.Unready):
            self._refuse(hand.address, answer.why)
            self.todo.append(task)
            self.todo.extend(self.hands.pop(hand.address).tasks.values())
            return []
        if answer.row.outcome == SET_ASIDE:
            self._fail(task, answer.row.error)
            return []
        self.slowest = max(self.slowest, answer.row.seconds)
        writer.publish(answer.row, answer.suffix)
        return [answer.row]

    def _fail(self, task: Task, why: str) -> None:
        """A block could not be computed: it runs again after the others, or is set aside."""
        if task.attempt < ATTEMPTS:
            (self.suspects if task.suspect else self.todo).append(task.again())
        else:
            self.failed.append((task, why))

    def _set_aside(self, writer: Writer, unfinished: Mapping[int, Row]) -> list[Row]:
        rows = []
        for task, why in self.failed:
            known = unfinished.get(task.block)
            attempt = max(task.attempt, task.deaths)
            rows.append(writer.commit(*set_aside(self.store, task.block, known, attempt, why)))
        self.failed.clear()
        return rows


def _of_dask(error: Exception) -> bool:
    """Whether Dask lost a task, rather than that a task failed."""
    return isinstance(error, OSError) or type(error).__module__.startswith("distributed.")


def _host(address: str) -> str:
    return address.rpartition(":")[0]


def _restart(client: "Client", address: str) -> None:
    """Restart a worker; Dask dismisses one that has no nanny."""
    with suppress(Exception):  # it is not used any more, whatever becomes of it
        client.restart_workers([address], raise_for_error=False)
