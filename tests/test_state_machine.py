"""Anything that is done to a store, in any order: plan, run, kill, resume, extend, change, damage,
repair, read.

The engine is replaced by a hash of a scenario's parameters, so that every cell's value is known,
and what is computed is counted. A kill is an exception that nothing catches, after which nothing
more reaches the disk. `FIC_SWEEP_TORTURE=1 pytest tests/test_state_machine.py -s` is the long form.
"""

import os
import re
import shutil
import sqlite3
import struct
import sys
import tempfile
import zlib
from collections import Counter
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pandas as pd
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
from sweeps.cli.interruption import Stop
from sweeps.provenance import provenance
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import load
from sweeps.store import commit, extend
from sweeps.store import format as layout
from sweeps.store import fsync as durable
from sweeps.store import lock as owner
from sweeps.store import opening as store
from sweeps.store.ledger import Ledger
from tests import faults
from tests.command import typed

TORTURE = bool(os.environ.get(faults.TORTURE))
EXAMPLES, STEPS = (500, 200) if TORTURE else (12, 25)
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # the disk is tested elsewhere
FACTS = provenance(32)  # asks git, once
COUNTED = Counter()  # of this session

# --- the engine: a scenario's value is a hash of its parameters ----------------------------------

FIELDS = list(fic_jax.QUANTITIES)
DEFAULTS = vars(fic_jax.Params()) | {"contact": "hard_stop", "law": "algorithm1"}


def key_of(scenario):
    """What a scenario is known by: all its numbers as the engine sees them, and its model."""
    numbers = struct.pack(f"{len(FIELDS)}f", *(scenario[name] for name in FIELDS))
    return numbers + f"{scenario['contact']} {scenario['law']}".encode()


def value_of(key):
    """Its metric, or None where it diverges."""
    word = zlib.crc32(key)
    return None if word % 5 == 0 else np.float32(1 + word / 2**32)


class Killed(BaseException):
    """No code of ours may catch this."""


class World:
    """The engine and the disk, and what they are told to do."""

    def __init__(self):
        self.dead, self.left = False, 0  # operations until a kill; 0: none is planned
        self.computed = []
        self.failing = lambda key: False
        self.path = Path()
        self.acknowledged = set()

    def compute(self, grid, block, dtype, cells):
        columns = {n: np.asarray(v, dtype) for n, v in vars(grid.params(block)).items()}
        shape = next(v.shape for v in columns.values() if v.ndim)
        rows = {n: np.broadcast_to(v, shape)[cells] for n, v in columns.items()}
        model = vars(grid.model(block))
        keys = [key_of({n: rows[n][i] for n in FIELDS} | model) for i in range(len(rows["K0"]))]
        if any(self.failing(key) for key in keys):
            raise RuntimeError("the device is gone")
        self.computed += keys
        values = [value_of(key) for key in keys]
        finite = np.array([value is not None for value in values])
        nmse = np.array([value if value is not None else np.inf for value in values], dtype)
        return SimpleNamespace(nmse=nmse, finite=finite), None

    def step(self):
        """One thing reaches the disk, or nothing does any more."""
        if self.dead:
            raise Killed
        if self.left:
            self.left -= 1
            if not self.left:
                self.dead = True
                raise Killed

    def around(self, original):
        """A step before it and one after it."""

        def stepping(*arguments, **named):
            self.step()
            done = original(*arguments, **named)
            self.step()
            return done

        return stepping

    def unless_dead(self, original):
        """What clears up: the dead don't."""
        return lambda *args, **named: None if self.dead else original(*args, **named)

    def add(self, original):
        """A row in the ledger is an acknowledgement."""

        def adding(ledger, rows):
            rows = list(rows)
            self.step()
            original(ledger, rows)
            if ledger.path.parent == self.path:
                self.acknowledged |= {row.block for row in rows}
            self.step()

        return adding

    def patches(self):
        calls = {name: self.around(getattr(os, name)) for name in ("write", "fsync", "replace")}
        disk = SimpleNamespace(**(vars(os) | calls | {"unlink": self.unless_dead(os.unlink)}))
        lock = SimpleNamespace(
            **vars(os)
            | {name: self.unless_dead(getattr(os, name)) for name in ("ftruncate", "pwrite")}
        )
        bin_ = SimpleNamespace(**vars(shutil) | {"rmtree": self.unless_dead(shutil.rmtree)})
        return [
            patch.object(runner, "_compute", self.compute),
            patch.object(runner, "provenance", lambda *_: FACTS),
            patch.object(durable, "os", disk),
            patch.object(owner, "os", lock),
            patch.object(layout, "shutil", bin_),
            patch.object(extend, "shutil", bin_),
            patch.object(layout, "lay_out", self.around(layout.lay_out)),
            patch.object(extend, "lay_out", self.around(layout.lay_out)),
            patch.object(Path, "rename", self.around(Path.rename)),
            patch.object(Ledger, "add", self.add(Ledger.add)),
            patch.object(Ledger, "fix", self.around(Ledger.fix)),
            patch.object(Ledger, "forget", self.around(Ledger.forget)),
            patch.object(Stop, "after_block", self.around(Stop.after_block)),
            patch.object(commit, "now", lambda: "2026-01-01T00:00:00+00:00"),
            patch.object(runner, "now", lambda: "2026-01-01T00:00:00+00:00"),
        ]


# --- plans ---------------------------------------------------------------------------------------

POOL = {"K0": [10.0, 50.0, 100.0, 150.0], "Td": [2.0, 5.0, 8.0], "sigma": [0.01, 0.02]}
CASES = [(0.0, 0.0), (0.0, 0.1), (63.2, 0.0), (63.2, 0.1), (189.7, 0.0)]  # Denv, gap
CHOICES = {"contact": ["hard_stop", "welded"], "law": ["algorithm1", "effort"]}


def subset(values, least=1):
    return st.lists(st.sampled_from(values), min_size=least, max_size=len(values), unique=True)


GRIDS = st.fixed_dictionaries(
    {
        "axes": st.dictionaries(st.sampled_from(list(POOL)), st.none(), min_size=1, max_size=2)
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
    lines = ['name = "machine"', 'metrics = ["nmse"]', f"time.t_end = {plan.get('t_end', 0.1)}"]
    lines += [f"constants.{n} = {v}" for n, v in plan.get("constants", {}).items()]
    lines += [f"model.{n} = {v}" for n, v in plan.get("model", {}).items()]
    lines += [f"axes.{n} = {v}" for n, v in plan.get("axes", {}).items()]
    if plan.get("cases"):
        lines += [f"cases.Denv = {[d for d, _ in plan['cases']]}"]
        lines += [f"cases.gap = {[g for _, g in plan['cases']]}"]
    if "sample" in plan:
        lines += ["[sample]", f"n = {plan['n']}", f"method = '{plan['sample']}'"]
        lines += [f"seed = {plan.get('seed', 3)}"]
        lines += ["ranges = { K0 = { log = [1.0, 100.0] }, Td = { lin = [1.0, 9.0] } }"]
    return "\n".join(lines)


def scenarios(plan, data=None):
    """Every scenario of a plan in storage order; those of a sample are taken from its store."""
    fixed = DEFAULTS | plan.get("constants", {})
    if "sample" in plan:
        drawn = zip(data["K0"].values, data["Td"].values, strict=True)
        return [fixed | {"K0": K0, "Td": Td} for K0, Td in drawn]
    sides = [[{n: v} for v in values] for n, values in [*plan["model"].items()]]
    sides += [[{n: v} for v in values] for n, values in plan["axes"].items()]
    if plan["cases"]:
        sides.append([{"Denv": d, "gap": g} for d, g in plan["cases"]])
    return [
        {k: v for part in (fixed, *parts) for k, v in part.items()} for parts in product(*sides)
    ]


def enlarged(plan, draw):
    """A plan that has all of this one, in any order, and more."""
    if "sample" in plan:
        return plan | {"n": plan["n"] + (0 if plan["sample"] == "lhs" else draw(st.integers(0, 4)))}
    axes = {n: draw(st.permutations(sorted({*v, *draw(subset(POOL[n]))})))
            for n, v in plan["axes"].items()}  # fmt: skip
    for name in sorted(POOL.keys() - axes):
        if draw(st.booleans()) and len(axes) < 2:
            axes[name] = draw(st.permutations(sorted({DEFAULTS[name], *draw(subset(POOL[name]))})))
    axes = {n: axes[n] for n in draw(st.permutations(sorted(axes)))}
    cases = plan["cases"]
    if cases:
        cases = draw(st.permutations(sorted({*cases, *draw(subset(CASES))})))
    elif draw(st.booleans()):
        cases = [(DEFAULTS["Denv"], DEFAULTS["gap"]), *draw(subset(CASES[:4]))]
    model = dict(plan["model"])
    for name, choices in CHOICES.items():
        if draw(st.booleans()):
            model[name] = draw(st.permutations(choices))
    return plan | {"axes": axes, "cases": cases, "model": model}


def refused(plan, draw):
    """A plan that lacks something, or changes something, of this one."""
    other = [plan | {"t_end": 0.2}, plan | {"constants": {"I": 11.0}}]
    if "sample" in plan:
        other += [plan | {"seed": 4}, plan | {"sample": "random" if plan["sample"] != "random"
                                              else "sobol"}]  # fmt: skip
        other += [plan | {"n": plan["n"] - 1}] if plan["n"] > 1 else []
        return draw(st.sampled_from(other))
    for part in ("axes", "model"):
        for name, values in plan[part].items():
            if len(values) > 1:
                other.append(plan | {part: plan[part] | {name: values[:-1]}})
            if len(values) > 1 and len(plan["axes"]) > 1:
                other.append(plan | {part: {k: v for k, v in plan[part].items() if k != name}})
    if len(plan["cases"]) > 1:
        other.append(plan | {"cases": plan["cases"][1:]})
    return draw(st.sampled_from(other))


# --- the machine ---------------------------------------------------------------------------------

KILL = st.just(0) | st.integers(1, 60)  # operations until then; 0: never


class Store(RuleBasedStateMachine):
    def __init__(self):
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(dir=MEMORY))
        self.path = self.folder / "machine.zarr"
        self.world = World()
        self.world.path = self.path
        self.patches = self.world.patches()
        for one in self.patches:
            one.start()
        self.plan, self.chunk, self.planned = None, 1, None  # planned: a larger one, if killed
        self.known = set()  # keys of scenarios that the ledger has
        self.damage = {}  # file -> what it had, of what nobody mended yet

    def teardown(self):
        try:
            if self.path.is_dir() or extend.away(self.path).is_dir():
                self.finish()
        finally:
            for one in self.patches:
                one.stop()
            shutil.rmtree(self.folder, ignore_errors=True)

    # --- what the rules are made of

    def type(self, *arguments, kill=0):
        """A command, perhaps killed: then its code is None."""
        self.world.dead, self.world.left, self.world.computed = False, kill, []
        COUNTED[arguments[0]] += 1
        try:
            told = typed(*arguments)
        except Killed:
            COUNTED["kills"] += 1
            return SimpleNamespace(code=None, stderr="", stdout="")
        finally:
            self.world.dead, self.world.left = False, 0
        note(f"{arguments} -> {told}")
        assert told.code in (0, 1, 2)
        assert "Traceback" not in told.stderr
        if told.code == 2:
            assert told.stderr.startswith("fic-sweep: ")
        return told

    def file_of(self, plan):
        path = self.folder / "plan.toml"
        path.write_text(written(plan))
        return path

    def rows(self):
        """The ledger, read by SQLite alone: block -> outcome."""
        with sqlite3.connect(self.path / "ledger.sqlite") as database:
            found = database.execute(
                "SELECT block, json_extract(body, '$.outcome') FROM blocks"
            ).fetchall()
        database.close()
        return dict(found)

    def cells(self):
        """Key and block of every cell in storage order."""
        grid = store.open_store(self.path).grid
        data = None
        if "sample" in self.plan:
            drawn = grid.coordinates("scenario")
            data = {n: SimpleNamespace(values=drawn[n]) for n in ("K0", "Td")}
        keys = [key_of(scenario) for scenario in scenarios(self.plan, data)]
        blocks = np.empty(grid.shape, int)
        for index in range(grid.n_blocks):
            blocks[grid.block(index)] = index
        return keys, blocks.ravel().tolist()

    def settle(self):
        """After a kill in an extension: the one store or the other, as `resume` finds it."""
        if self.planned is None:
            return
        extend.recover(self.path)
        record = store.open_store(self.path).grid.sweep
        if record == load(self.file_of(self.planned)):
            self.plan = self.planned
        else:
            assert record == load(self.file_of(self.plan))
        self.planned = None
        assert not extend.away(self.path).exists()

    def learn(self):
        """Whatever the ledger says is done is known from now on."""
        keys, blocks = self.cells()
        outcomes = self.rows()
        done = {key for key, b in zip(keys, blocks, strict=True) if outcomes.get(b) == "done"}
        self.known |= done
        return done

    def forgive(self, before):
        """Blocks that were damaged, or partly done when a kill came, may be computed again."""
        keys, blocks = self.cells()
        outcomes = self.rows()
        self.known &= {k for k, b in zip(keys, blocks, strict=True) if b in outcomes} | before

    def check_known(self):
        """No acknowledged block is lost."""
        keys, blocks = self.cells()
        outcomes = self.rows()
        lost = {b for k, b in zip(keys, blocks, strict=True) if k in self.known} - outcomes.keys()
        assert not lost, lost

    def new_only(self, told=None):
        """Nothing known was computed again, and nothing twice."""
        again = Counter(self.world.computed)
        assert not again or max(again.values()) == 1
        if not self.damage:
            assert not self.known & set(again)

    def look(self, data):
        """Every cell that says it is good is right, and every known one says so."""
        status = data["status"].values.ravel()
        nmse = data["nmse"].values.ravel()
        for at, scenario in enumerate(scenarios(self.plan, data)):
            key = key_of(scenario)
            expected = value_of(key)
            if status[at] == store.OK:
                assert nmse[at] == expected
            elif status[at] != store.NOT_RUN or nmse[at] != expected:  # a kill may leave a file
                assert np.isnan(nmse[at])
            if status[at] == store.DIVERGED:
                assert expected is None
            if key in self.known:
                assert status[at] == (store.DIVERGED if expected is None else store.OK)
        COUNTED["cells looked at"] += len(status)
        return Counter(status.tolist())

    # --- rules

    @initialize(plan=GRIDS | SAMPLES, chunk=st.integers(1, 5), kill=KILL)
    def begin(self, plan, chunk, kill):
        self.plan, self.chunk = plan, chunk
        self.run(kill)

    @precondition(lambda self: not self.path.exists())
    @rule(kill=KILL)
    def run(self, kill):
        told = self.type(
            "run", self.file_of(self.plan), "--out", self.path, "--chunk", self.chunk, kill=kill
        )
        assert told.code == (None if told.code is None else 0)
        if self.path.exists():
            self.learn()
            self.new_only_first()
        else:
            assert told.code is None

    def new_only_first(self):
        assert not self.world.computed or max(Counter(self.world.computed).values()) == 1

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule(kill=KILL, fails=st.sampled_from([0, 0, 3, 2]))
    def resume(self, kill, fails):
        """Perhaps on a machine that fails for some scenarios."""
        self.settle()
        outcomes = self.rows()
        partly = {b for b, outcome in outcomes.items() if outcome != "done"}
        self.world.failing = lambda key: fails and zlib.crc32(key, 1) % fails == 0
        told = self.type("resume", self.path, kill=kill)
        self.world.failing = lambda key: False
        self.new_only()
        if told.code is None:
            self.lose_partly(partly)
        elif told.code == 1:
            assert fails
            assert "failed and set aside" in told.stderr
        else:
            assert told.code == 0
            assert set(self.rows().values()) == {"done"}
        self.learn()
        self.check_known()

    def lose_partly(self, partly):
        """A block that was partly done may have lost its row while it was written anew."""
        keys, blocks = self.cells()
        gone = partly - self.rows().keys()
        self.known -= {k for k, b in zip(keys, blocks, strict=True) if b in gone}

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule(data=st.data(), kill=KILL)
    def extend(self, data, kill):
        self.settle()
        before = self.plan
        larger = enlarged(self.plan, data.draw)
        self.learn()
        self.planned = larger
        partly = set()
        told = self.type("resume", self.path, "--extend", self.file_of(larger), kill=kill)
        if told.code is None:
            self.settle()
            partly = {b for b in range(store.open_store(self.path).grid.n_blocks)}
            self.lose_partly(partly - {b for b, o in self.rows().items() if o == "done"})
        else:
            assert told.code == 0, told
            self.plan, self.planned = larger, None
            assert set(self.rows().values()) == {"done"}
        self.new_only()
        self.learn()
        self.check_known()
        COUNTED["extended"] += self.plan != before

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule(data=st.data())
    def extend_wrongly(self, data):
        self.settle()
        before = contents(self.path)
        told = self.type(
            "resume", self.path, "--extend", self.file_of(refused(self.plan, data.draw))
        )
        assert told.code == 2
        assert all(line.startswith("fic-sweep: ") for line in told.stderr.splitlines())
        assert not self.world.computed
        assert contents(self.path) == before

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule(what=st.sampled_from(["sweep", "program", "dtype", "jax", "block_cells"]))
    def change(self, what):
        """Behind our back: refused, nothing changed, and good again once it is put back."""
        self.settle()
        place = self.path / "zarr.json"
        good = place.read_bytes()
        text = good.decode()
        old, new = {
            "sweep": (r"\"machine\"", r"\"machina\""),
            "program": (FACTS["program"], "0123456789abcdef"),
            "dtype": ('"dtype": "float32"', '"dtype": "float64"'),
            "jax": (f'"jax": "{FACTS["jax"]}"', '"jax": "0.0.1"'),
            "block_cells": (f'cells": {self.chunk}', f'cells": {self.chunk + 1}'),
        }[what]
        assert old in text
        place.write_text(text.replace(old, new))
        before = contents(self.path)
        told = self.type("resume", self.path)
        assert told.code == 2
        assert len(told.stderr.splitlines()) == 1
        assert not self.world.computed
        assert contents(self.path) == before
        assert self.type("verify", self.path).code in (1, 2)
        place.write_bytes(good)

    @precondition(lambda self: self.path.exists() and self.planned is None)
    @rule(data=st.data(), how=st.sampled_from(["flip", "truncate", "delete", "zero"]))
    def corrupt(self, data, how):
        names = sorted(
            p.relative_to(self.path).as_posix()
            for p in self.path.rglob("*")
            if p.is_file() and p.stat().st_size and p.name not in (owner.NAME,)
        )
        name = data.draw(st.sampled_from(names))
        place = self.path / name
        content = bytearray(place.read_bytes())
        at = data.draw(st.integers(0, len(content) - 1))
        if how == "flip":
            content[at] ^= 1 << data.draw(st.integers(0, 7))
        elif how == "truncate":
            del content[at:]
        elif how == "zero":
            if not any(content[at : at + 9]):
                return
            content[at : at + 9] = bytes(len(content[at : at + 9]))
        self.damage.setdefault(name, place.read_bytes())
        place.unlink() if how == "delete" else place.write_bytes(content)
        COUNTED[f"damaged {'ledger' if 'ledger' in name else 'file'}s"] += 1

    @precondition(lambda self: self.damage)
    @rule()
    def read_damaged(self):
        """Refused, or right: never a wrong number that says it is good."""
        told = self.type("status", self.path)
        assert told.code in (0, 2)
        try:
            with store.dataset(self.path) as data:
                data.load()
        except (SweepError, OSError, ValueError, RuntimeError):
            return
        known, self.known = self.known, set()
        self.look(data)
        self.known = known

    @precondition(lambda self: self.damage)
    @rule()
    def resume_damaged(self):
        """Refused, or what it does is right and spoils nothing."""
        if "ledger.sqlite" in self.damage:
            return
        told = self.type("resume", self.path)
        assert told.code in (0, 1, 2)
        if told.code == 2:
            assert len(told.stderr.splitlines()) == 1
        self.world.computed = []

    @precondition(lambda self: self.damage)
    @rule(kill=KILL)
    def repair(self, kill):
        bad = {name for name, was in self.damage.items() if self.is_bad(name, was)}
        committed = {name for name in bad if self.is_committed(name)}
        told = self.type("verify", self.path)
        if committed:
            assert told.code == 1 or {"zarr.json", "ledger.sqlite"} <= bad, (committed, told)
            if len(committed) < 20 and not any(n.endswith(("zarr.json", "sqlite")) for n in bad):
                assert all(name in told.stdout for name in committed - {"ledger.sha256"})
        told = self.type("verify", self.path, "--repair", kill=kill)
        if told.code is None:
            return
        if told.code == 2:  # too much is lost
            assert {"zarr.json", "ledger.sqlite"} <= bad, told
            shutil.rmtree(self.path)
            self.known, self.damage = set(), {}
            return
        assert told.code == 0, told
        COUNTED["repaired"] += 1
        lost_ledger, self.damage = "ledger.sqlite" in bad, {}
        if lost_ledger:
            self.known = set()
        else:
            self.lose_partly({b for b in range(store.open_store(self.path).grid.n_blocks)}
                             - {b for b, o in self.rows().items()})  # fmt: skip
        self.learn()
        self.check_known()
        assert self.type("verify", self.path).code == 0

    def is_bad(self, name, was):
        place = self.path / name
        return not place.is_file() or place.read_bytes() != was

    def is_committed(self, name):
        """Whether `verify` must find it: no file of a block that was under way."""
        if name.endswith((".partial", "-journal")) or name == "ledger.sha256":
            return False
        if name == "ledger.sqlite":
            return (self.path / "ledger.sha256").is_file()
        if not re.fullmatch(r"(nmse|status)/c\..*", name) or "ledger.sqlite" in self.damage:
            return not (name.startswith(("nmse/c", "status/c")))
        try:
            opened = store.open_store(self.path)
            files = {opened.file(v, b).relative_to(self.path).as_posix()
                     for b in self.rows() for v in ("nmse", "status")}  # fmt: skip
        except (SweepError, sqlite3.Error):
            return False
        return name in files

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule()
    def read(self):
        """Store, status lines and export agree with each other and with the engine."""
        self.settle()
        with store.dataset(self.path) as data:
            counts = self.look(data)
        told = self.type("status", self.path)
        assert told.code == 0
        outcomes, (_, blocks) = self.rows(), self.cells()
        flags = data["status"].values.ravel().tolist()
        # a block that was killed before its row is there, and is right, but is not done
        noted = Counter(f if b in outcomes else 0 for f, b in zip(flags, blocks, strict=True))
        for word, flag in store.STATUS.items():
            assert re.search(rf"^  {word} +{noted[flag]}$", told.stdout, re.M), told.stdout
        target = self.folder / "table.csv"
        target.unlink(missing_ok=True)
        assert self.type("export", self.path, "--to", "csv", "--out", target).code == 0
        table = pd.read_csv(target)
        assert Counter(table["status"]) == Counter(
            {word: counts[flag] for word, flag in store.STATUS.items() if counts[flag]}
        )
        good = table["status"] == "ok"
        np.testing.assert_allclose(
            table["nmse"][good], data["nmse"].values.ravel()[good], rtol=1e-6
        )

    @precondition(lambda self: self.path.exists() and not self.damage)
    @rule()
    def verify(self):
        self.settle()
        told = self.type("verify", self.path)
        assert told.code == 0, told

    @invariant()
    def acknowledged_blocks_stay(self):
        if self.path.exists() and not self.damage and self.planned is None and self.known:
            self.check_known()

    def finish(self):
        """In the end it is complete, and the same as an undisturbed run of its plan."""
        self.settle()
        for name, was in self.damage.items():  # its owner has a copy
            (self.path / name).write_bytes(was)
        if self.damage:
            self.damage = {}
            self.type("verify", self.path, "--repair")
        assert self.type("resume", self.path).code == 0
        with store.dataset(self.path) as data:
            counts = self.look(data)
        assert not counts[store.NOT_RUN] + counts[store.FAILED]
        fresh = self.folder / "fresh.zarr"
        told = self.type("run", self.file_of(self.plan), "--out", fresh, "--chunk", self.chunk)
        assert told.code == 0
        ours, theirs = contents(self.path), contents(fresh)
        for notes in ("zarr.json", "ledger.sqlite", "ledger.sha256"):
            ours.pop(notes, None), theirs.pop(notes, None)
        assert ours == theirs
        COUNTED["finished"] += 1


def contents(path):
    """Every file of a store but the lock, in which an owner that was killed leaves its name."""
    files = (p for p in path.rglob("*") if p.is_file() and p.name != owner.NAME)
    return {p.relative_to(path).as_posix(): p.read_bytes() for p in files}


def test_anything_in_any_order(capsys):
    run_state_machine_as_test(
        Store,
        settings=settings(
            max_examples=EXAMPLES,
            stateful_step_count=STEPS,
            deadline=None,
            derandomize=True,
            database=None,
            phases=[Phase.generate],  # to shrink what is found takes hours
            print_blob=False,
            suppress_health_check=list(HealthCheck),
        ),
    )
    rare = ("damaged ledgers",) if TORTURE else ()
    for what in ("kills", "extended", "repaired", "finished", "damaged files", *rare):
        assert COUNTED[what], COUNTED  # a machine that does nothing proves nothing
    if TORTURE:
        with capsys.disabled():
            sys.stdout.write(f"\n{EXAMPLES} x {STEPS}: {dict(COUNTED)}\n")
