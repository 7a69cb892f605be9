"""Runs, kills, resumes, extensions, damage and repairs of a store, in any order.

A hash of a scenario's parameters replaces the engine, so that every cell's value is known and every
computation is counted. `FIC_SWEEP_TORTURE=1 pytest -s tests/store/test_state_machine.py` is longer.
"""

import shutil
import sqlite3
import struct
import sys
import tempfile
import zlib
from collections import Counter
from contextlib import ExitStack, closing
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, Phase, note, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

import fic_jax
from sweeps import runner
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import load
from sweeps.store import extend
from sweeps.store.create import before_extension
from sweeps.store.format import DIVERGED, FAILED, NOT_RUN, OK, STATUS
from sweeps.store.lock import LOCK
from sweeps.store.opening import dataset, open_store
from tests.command import typed
from tests.store.faults import Calls, Killed
from tests.store.stores import without_engine
from tests.torture import many

EXAMPLES, STEPS = many((8, 25), (500, 200))
FACTS = runner.provenance(32)  # runs git once
COUNTED = Counter()  # what the machine did

# --- the engine: a scenario's value is a hash of its parameters ----------------------------------

FIELDS = list(fic_jax.QUANTITIES)
DEFAULTS = vars(fic_jax.Params()) | {"contact": "hard_stop", "law": "algorithm1"}


def key_of(scenario):
    """A scenario's parameters, as the engine sees them, and its model."""
    numbers = struct.pack(f"{len(FIELDS)}f", *(scenario[name] for name in FIELDS))
    return numbers + f"{scenario['contact']} {scenario['law']}".encode()


def value_of(key):
    """A scenario's metric, or None if it diverges."""
    word = zlib.crc32(key)
    return None if word % 5 == 0 else np.float32(1 + word / 2**32)


class Engine:
    """Computes blocks, records the scenarios, and fails for some."""

    def __init__(self):
        self.computed, self.fails = [], lambda key: False

    def compute(self, grid, block, dtype, cells):
        columns = {n: np.asarray(v, dtype) for n, v in vars(grid.params(block)).items()}
        shape = next(v.shape for v in columns.values() if v.ndim)
        columns = {n: np.broadcast_to(v, shape)[cells] for n, v in columns.items()}
        model = vars(grid.model(block))
        scenarios = zip(*(columns[n] for n in FIELDS), strict=True)
        keys = [key_of(dict(zip(FIELDS, values, strict=True)) | model) for values in scenarios]
        if any(self.fails(key) for key in keys):
            raise RuntimeError("the device is gone")
        self.computed += keys
        nmse = [value_of(key) for key in keys]
        finite = np.array([value is not None for value in nmse])
        nmse = np.array([value or np.inf for value in nmse], dtype)
        return SimpleNamespace(nmse=nmse, finite=finite), None


# --- plans ---------------------------------------------------------------------------------------

POOL = {"K0": [10.0, 50.0, 100.0, 150.0], "Td": [2.0, 5.0, 8.0], "sigma": [0.01, 0.02]}
CASES = [(0.0, 0.0), (0.0, 0.1), (63.2, 0.0), (63.2, 0.1), (189.7, 0.0)]  # Denv, gap
CHOICES = {"contact": ["hard_stop", "welded"], "law": ["algorithm1", "effort"]}


def subset(values):
    return st.lists(st.sampled_from(values), min_size=1, max_size=len(values), unique=True)


GRIDS = st.fixed_dictionaries(
    {
        "axes": st.lists(st.sampled_from(list(POOL)), min_size=1, max_size=2, unique=True)
        .flatmap(lambda names: st.fixed_dictionaries({n: subset(POOL[n]) for n in names})),
        "cases": st.just([]) | subset(CASES),
        "model": st.fixed_dictionaries({}, optional={n: subset(c) for n, c in CHOICES.items()}),
    }
)  # fmt: skip
SAMPLES = st.fixed_dictionaries(
    {"sample": st.sampled_from(["sobol", "random", "lhs"]), "n": st.integers(1, 9)}
)


def written(plan):
    """The sweep file of a plan."""
    lines = ['name = "machine"', 'metrics = ["nmse"]', "time.t_end = 0.1"]
    lines += [f"model.{n} = {v}" for n, v in plan.get("model", {}).items()]
    lines += [f"axes.{n} = {v}" for n, v in plan.get("axes", {}).items()]
    if plan.get("cases"):
        lines += [f"cases.Denv = {[d for d, _ in plan['cases']]}"]
        lines += [f"cases.gap = {[g for _, g in plan['cases']]}"]
    if "sample" in plan:
        lines += ["[sample]", f"n = {plan['n']}", f"method = '{plan['sample']}'", "seed = 3"]
        lines += ["ranges = { K0 = { log = [1.0, 100.0] }, Td = { lin = [1.0, 9.0] } }"]
    return "\n".join(lines)


def scenarios(plan, coordinates):
    """Every scenario of a plan in storage order; `coordinates` has the values of a sample."""
    if "sample" in plan:
        pairs = zip(coordinates["K0"], coordinates["Td"], strict=True)
        return [DEFAULTS | {"K0": float(K0), "Td": float(Td)} for K0, Td in pairs]
    sides = [[{n: v} for v in values] for n, values in (plan["model"] | plan["axes"]).items()]
    if plan["cases"]:
        sides.append([{"Denv": d, "gap": g} for d, g in plan["cases"]])
    return [
        {k: v for part in (DEFAULTS, *parts) for k, v in part.items()} for parts in product(*sides)
    ]


def enlarged(plan, draw):
    """A plan with all of this one, in any order, and perhaps more."""
    if "sample" in plan:
        return plan | {"n": plan["n"] + (0 if plan["sample"] == "lhs" else draw(st.integers(0, 4)))}
    axes = {n: sorted({*v, *draw(subset(POOL[n]))}) for n, v in plan["axes"].items()}
    for name in sorted(POOL.keys() - axes):
        if draw(st.booleans()) and len(axes) < 2:
            axes[name] = sorted({DEFAULTS[name], *draw(subset(POOL[name]))})
    axes = {n: draw(st.permutations(axes[n])) for n in draw(st.permutations(sorted(axes)))}
    cases = plan["cases"]
    if cases:
        cases = draw(st.permutations(sorted({*cases, *draw(subset(CASES))})))
    elif draw(st.booleans()):
        cases = [(DEFAULTS["Denv"], DEFAULTS["gap"]), *draw(subset(CASES[:4]))]
    more = {n: draw(st.permutations(c)) for n, c in CHOICES.items() if draw(st.booleans())}
    return plan | {"axes": axes, "cases": cases, "model": plan["model"] | more}


# --- the machine ---------------------------------------------------------------------------------

KILL = st.just(0) | st.integers(1, 150)  # the call at which the process is killed; 0: none


class Store(RuleBasedStateMachine):
    def __init__(self):
        super().__init__()
        self.closing = ExitStack()
        memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
        self.folder = Path(self.closing.enter_context(tempfile.TemporaryDirectory(dir=memory)))
        self.path, self.engine = self.folder / "machine.zarr", Engine()
        patch = self.closing.enter_context(pytest.MonkeyPatch.context())
        encode = runner.Writer._encode
        without_engine(patch)
        patch.setattr(runner.Writer, "_encode", encode)
        patch.setattr(runner, "_compute", self.engine.compute)
        patch.setattr(runner, "provenance", lambda *_: FACTS)
        self.planned = None  # the plan of an extension, while it may have been killed
        self.known = set()  # scenarios of done blocks
        self.damage = {}  # file -> its content before

    def teardown(self):
        with self.closing:
            if self.path.is_dir() or before_extension(self.path).is_dir():
                self.finish()

    # --- what the rules are made of

    def command(self, *arguments, kill=0):
        """A command, perhaps killed: then its code is None."""
        self.engine.computed.clear()
        COUNTED[arguments[0]] += 1
        try:
            with Calls(self.folder, lambda call: Killed if call.number == kill - 1 else None):
                done = typed(*arguments)
        except Killed:
            COUNTED["kills"] += 1
            return SimpleNamespace(code=None, stderr="", stdout="")
        note(f"{arguments} -> {done}")
        assert done.code in (0, 1, 2)
        return done

    def file_of(self, plan):
        path = self.folder / "plan.toml"
        path.write_text(written(plan))
        return path

    def rows(self):
        """The ledger, read by SQLite alone: block -> outcome."""
        query = "SELECT block, json_extract(body, '$.outcome') FROM blocks"
        with closing(sqlite3.connect(self.path / "ledger.sqlite")) as database:
            return dict(database.execute(query).fetchall())

    def cells(self):
        """Key and block of every cell, in storage order."""
        grid = open_store(self.path).grid
        drawn = grid.coordinates("scenario") if "sample" in self.plan else None
        blocks = np.empty(grid.shape, int)
        for index in range(grid.n_blocks):
            blocks[grid.block(index)] = index
        keys = [key_of(scenario) for scenario in scenarios(self.plan, drawn)]
        return list(zip(keys, blocks.ravel().tolist(), strict=True))

    def settle(self):
        """After a kill in an extension: the store is the old one or the new one."""
        if self.planned:
            extend.recover(self.path)
            assert not before_extension(self.path).exists()
            sweep = open_store(self.path).grid.sweep
            if sweep == load(self.file_of(self.planned)):
                self.plan = self.planned
            assert sweep == load(self.file_of(self.plan))
            self.planned = None

    def learn(self, may_lose=()):
        """Every known scenario is in a block with a row, but for the blocks in `may_lose`."""
        rows, cells = self.rows(), self.cells()
        self.known -= {key for key, block in cells if block in may_lose and block not in rows}
        assert not {block for key, block in cells if key in self.known} - rows.keys()
        self.known |= {key for key, block in cells if rows.get(block) == "done"}

    def check_computed(self):
        """Nothing was computed twice, and nothing that was known."""
        again = Counter(self.engine.computed)
        assert not again or max(again.values()) == 1
        assert self.damage or not self.known & set(again)

    def check_values(self, data, known):
        """Every cell that is ok is right, and every known one is ok or diverged."""
        status, nmse = data["status"].values.ravel(), data["nmse"].values.ravel()
        for i, scenario in enumerate(scenarios(self.plan, data.coords)):
            expected = value_of(key_of(scenario))
            if status[i] == OK:
                assert nmse[i] == expected
            elif status[i] != NOT_RUN or nmse[i] != expected:  # a kill may leave a right file
                assert np.isnan(nmse[i])
            if status[i] == DIVERGED:
                assert expected is None
            if key_of(scenario) in known:
                assert status[i] == (DIVERGED if expected is None else OK)
        return status.tolist()

    # --- rules

    @initialize(plan=GRIDS | SAMPLES, chunk=st.integers(1, 5), kill=KILL)
    def begin(self, plan, chunk, kill):
        self.plan, self.chunk = plan, chunk
        self.run(kill)

    @precondition(lambda self: not self.path.exists())
    @rule(kill=KILL)
    def run(self, kill):
        plan = self.file_of(self.plan)
        done = self.command("run", plan, "--out", self.path, "--chunk", self.chunk, kill=kill)
        assert done.code in (None, 0)
        assert self.path.exists() or done.code is None
        if self.path.exists():
            self.check_computed()
            self.learn()

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule(kill=KILL, fails=st.sampled_from([0, 0, 3, 2]))
    def resume(self, kill, fails):
        """Perhaps on a machine that fails for some scenarios."""
        self.settle()
        partly = {block for block, outcome in self.rows().items() if outcome != "done"}
        self.engine.fails = lambda key: fails and zlib.crc32(key, 1) % fails == 0
        done = self.command("resume", self.path, kill=kill)
        self.engine.fails = lambda key: False
        self.check_computed()
        if done.code == 1:
            assert fails
            assert "failed and set aside" in done.stderr
        elif done.code is not None:
            assert set(self.rows().values()) == {"done"}
        self.learn(may_lose=partly if done.code is None else ())

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule(data=st.data(), kill=KILL)
    def extend(self, data, kill):
        self.settle()
        self.learn()
        self.planned = enlarged(self.plan, data.draw)
        COUNTED["extended"] += self.planned != self.plan
        plan = self.file_of(self.planned)
        done = self.command("resume", self.path, "--extend", plan, kill=kill)
        assert done.code in (None, 0), done
        self.settle()
        self.check_computed()
        # a block that was known in part loses its row while it is written again
        self.learn(may_lose=range(10**6) if done.code is None else ())
        if done.code == 0:
            assert set(self.rows().values()) == {"done"}

    @precondition(lambda self: self.path.exists() and not self.planned and len(self.damage) < 3)
    @rule(data=st.data(), how=st.sampled_from(["flip", "cut", "delete", "zero"]))
    def corrupt(self, data, how):
        files = (p for p in self.path.rglob("*") if p.is_file() and p.name != LOCK)
        name = data.draw(st.sampled_from(sorted(str(p.relative_to(self.path)) for p in files)))
        place = self.path / name
        content = bytearray(place.read_bytes())
        if how == "delete" or not content:
            place.unlink()
        else:
            at = data.draw(st.integers(0, len(content) - 1))
            flipped = content[at : at + 1] if how != "flip" else bytes([content[at] ^ 1])
            tail = b"" if how == "cut" else bytes(9) if how == "zero" else flipped
            place.write_bytes(content[:at] + tail + content[at + len(tail or content) :])
        self.damage.setdefault(name, bytes(content))
        COUNTED["damaged files"] += 1

    @precondition(lambda self: self.damage)
    @rule()
    def read_damaged(self):
        """Refused, or every cell that is ok is right."""
        assert self.command("status", self.path).code in (0, 2)
        try:
            with dataset(self.path) as data:
                data.load()
        except (SweepError, OSError, ValueError, RuntimeError):
            return
        self.check_values(data, known=set())

    @precondition(lambda self: self.damage and "ledger.sqlite" not in self.damage)
    @rule()
    def resume_damaged(self):
        """Refused, or right: a later rule looks."""
        done = self.command("resume", self.path)
        assert done.code != 2 or len(done.stderr.splitlines()) == 1

    @precondition(lambda self: self.damage)
    @rule(kill=KILL)
    def repair(self, kill):
        bad = {name for name, content in self.damage.items() if self.differs(name, content)}
        surely = {name for name in bad if self.is_committed(name)}
        report = self.command("verify", self.path)
        if surely:
            assert report.code == 1 or {"zarr.json", "ledger.sqlite"} <= bad, (surely, report)
        if not any(name.endswith(("zarr.json", "sqlite")) for name in bad) and len(surely) < 20:
            assert all(name in report.stdout for name in surely)
        done = self.command("verify", self.path, "--repair", kill=kill)
        if done.code is None:
            return
        if done.code == 2:  # too much is lost
            assert {"zarr.json", "ledger.sqlite"} <= bad, done
            shutil.rmtree(self.path)
            self.known, self.damage = set(), {}
            return
        assert done.code == 0, done
        COUNTED["repaired"] += 1
        if "ledger.sqlite" in bad:
            self.known = set()
        self.damage = {}
        self.learn(may_lose=range(10**6))
        assert self.command("verify", self.path).code == 0

    def differs(self, name, content):
        place = self.path / name
        return not place.is_file() or place.read_bytes() != content

    def is_committed(self, name):
        """Whether `verify` must find this damage: not in a file of an unfinished block."""
        if name.endswith((".partial", "-journal", ".sha256")):
            return False
        if name == "ledger.sqlite":
            return (self.path / "ledger.sha256").is_file()
        if not name.startswith(("nmse/c", "status/c")):
            return True
        try:
            store = open_store(self.path)
            return any(
                store.file(variable, block) == self.path / name
                for block in self.rows()
                for variable in ("nmse", "status")
            )
        except (SweepError, sqlite3.Error):
            return False

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule()
    def read(self):
        """Store, `status`, `export` and `verify` agree with each other and with the engine."""
        self.settle()
        with dataset(self.path) as data:
            flags = self.check_values(data, self.known)
            nmse = data["nmse"].values.ravel()
        done, rows = self.command("status", self.path), self.rows()
        assert done.code == 0
        # the ledger has no row for a block whose files a kill left, however right they are
        counts = Counter(
            flag if block in rows else NOT_RUN
            for flag, (_, block) in zip(flags, self.cells(), strict=True)
        )
        for word, flag in STATUS.items():
            assert f"\n  {word:8}{counts[flag]:>14,}\n" in done.stdout
        target = self.folder / "table.csv"
        export = ("export", self.path, "--to", "csv", "--out", target, "--force")
        assert self.command(*export).code == 0
        table = pd.read_csv(target)
        assert [STATUS[word] for word in table["status"]] == flags
        np.testing.assert_allclose(table["nmse"], nmse, rtol=1e-6)
        assert self.command("verify", self.path).code == 0

    @invariant()
    def known_blocks_stay(self):
        if self.path.exists() and not self.damage and not self.planned:
            self.learn()

    def finish(self):
        """At the end the store is complete, with the files of an undisturbed run of its plan."""
        self.settle()
        for name, content in self.damage.items():  # from a backup
            (self.path / name).write_bytes(content)
        if self.damage:
            self.command("verify", self.path, "--repair")
        assert self.command("resume", self.path).code == 0
        with dataset(self.path) as data:
            assert not {NOT_RUN, FAILED} & set(self.check_values(data, self.known))
        fresh, plan = self.folder / "fresh.zarr", self.file_of(self.plan)
        assert self.command("run", plan, "--out", fresh, "--chunk", self.chunk).code == 0
        assert blocks_of(self.path) == blocks_of(fresh)
        COUNTED["finished"] += 1


def blocks_of(path):
    """Every file in the folders of the arrays."""
    return {str(p.relative_to(path)): p.read_bytes() for p in path.glob("*/*")}


def test_anything_in_any_order():
    run_state_machine_as_test(
        Store,
        settings=settings(
            max_examples=EXAMPLES,
            stateful_step_count=STEPS,
            deadline=None,
            derandomize=True,
            database=None,
            phases=[Phase.generate],  # shrinking takes hours
            print_blob=False,
            suppress_health_check=list(HealthCheck),
        ),
    )
    for what in ("kills", "extended", "repaired", "finished", "damaged files"):
        assert COUNTED[what], COUNTED  # a machine that does nothing proves nothing
    sys.stdout.write(f"\n{EXAMPLES} x {STEPS}: {dict(COUNTED)}\n")
