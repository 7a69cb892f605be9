"""Every command that a message prints works when it is pasted into a shell, and helps."""

import ast
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from sweeps import runner
from sweeps.cli import interruption
from sweeps.store.opening import open_store
from sweeps.store.place import before_extension
from tests.cli.conftest import TINY
from tests.command import FIC_SWEEP, typed
from tests.store.conftest import GOLDEN

STORE = "it's my store.zarr"
PLOT = ("plot", STORE, "--x", "Td", "--y", "K0")
ROOT = Path(__file__).parent.parent.parent


@pytest.fixture
def store(ran, folder):
    return Path(shutil.copytree(ran / "tiny.zarr", folder / STORE))


def advice(ended):
    """The commands that a message prints."""
    return re.findall("`(fic-sweep [^`]+)`", ended.stderr + ended.stdout)


def pasted(line):
    """Run a printed line in a shell, as a user does; returns its exit code."""
    variables = {"PATH": f"{os.path.dirname(FIC_SWEEP)}:{os.environ['PATH']}", "PYTHONUTF8": "1"}
    return subprocess.run(["bash", "-c", line], env=os.environ | variables, check=False).returncode


def ledger_gone(store):
    (store / "ledger.sqlite").unlink()


def row_gone(store):
    """As in a store whose ledger lost its rows: the files of its block are all there."""
    open_store(store).ledger.delete([0])


def half_written(store):
    row_gone(store)
    next((store / "nmse").glob("c.*")).unlink()


def file_gone(store):
    next((store / "nmse").glob("c.*")).unlink()


def record_gone(store):
    (store / "zarr.json").unlink()


def record_damaged(store):
    (store / "zarr.json").write_text((store / "zarr.json").read_text().replace("K0", "K1"))


def metadata_damaged(store):
    (store / "K0" / "zarr.json").write_text("{}")


def extension_cut_short(store):
    store.rename(before_extension(store))


def untouched(_):
    """A whole store, in the way of another, or beside a file that is no store."""


EXPORT = ("export", STORE, "--to", "csv")
MESSAGES = [  # how the store is damaged, the command that complains
    *((ledger_gone, words) for words in (("status", STORE), ("resume", STORE), PLOT, EXPORT)),
    (ledger_gone, ("verify", STORE)),
    (half_written, PLOT),
    (half_written, ("verify", STORE)),
    (file_gone, EXPORT),
    (file_gone, ("verify", STORE)),
    *((record_gone, words) for words in (("status", STORE), ("resume", STORE), PLOT)),
    (record_damaged, ("status", STORE)),
    (metadata_damaged, PLOT),
    (metadata_damaged, ("resume", STORE)),
    (extension_cut_short, ("status", STORE)),
    (extension_cut_short, ("run", "tiny.toml", "--out", STORE)),
    (untouched, ("run", "tiny.toml", "--out", STORE)),
    (untouched, ("status", "my sweep.toml")),
]


@pytest.mark.parametrize(
    ("damage", "command"), MESSAGES, ids=lambda one: getattr(one, "__name__", None) or one[0]
)
def test_the_command_of_a_message_helps(store, damage, command):
    Path("my sweep.toml").write_text(TINY)
    damage(store)
    ended = typed(*command)
    assert ended.code in (1, 2)
    assert len(ended.stderr.splitlines()) == (ended.code == 2)
    commands = advice(ended)
    assert len(commands) == 1, ended
    assert pasted(commands[0]) == 0
    for name in ("status", "verify", "resume"):
        assert typed(name, STORE).code == 0
    assert "12 of 12 cells" in typed("status", STORE).stdout


def test_an_interrupted_run_says_how_to_continue(folder, monkeypatch):
    class AtOnce(interruption.Stop):
        def after_block(self, progress):
            self.requested = True
            super().after_block(progress)

    monkeypatch.setattr(interruption, "Stop", AtOnce)
    ended = typed("run", "tiny.toml", "--chunk", "1", "--out", STORE)
    assert ended.code == 1
    (resume,) = advice(ended)
    monkeypatch.undo()
    monkeypatch.chdir(folder)
    assert pasted(resume) == 0
    assert "12 of 12 cells" in typed("status", STORE).stdout


def test_failed_blocks_say_how_to_try_again(folder, monkeypatch):
    monkeypatch.setattr(runner, "_compute", lambda *_: 1 / 0)
    ended = typed("run", "tiny.toml", "--out", "-my store.zarr")
    assert ended.code == 1
    (resume,) = advice(ended)
    assert pasted(resume) == 0
    assert "12 of 12 cells" in typed("status", "./-my store.zarr").stdout


def test_a_store_of_another_definition_says_how_to_run_it_again(folder):
    shutil.copytree(GOLDEN / "format-2.zarr", folder / STORE)
    ended = typed("resume", STORE)
    assert ended.code == 2
    (again,) = advice(ended)
    assert pasted(again) == 0


def test_no_message_writes_a_command_by_hand():
    """`command` quotes it. The pictures do not know the path of their store."""
    by_hand = set()
    for path in ROOT.glob("sweeps/**/*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        documentation = {
            id(node.value)
            for node in ast.walk(tree)
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        }
        for node in ast.walk(tree):
            text = isinstance(node, ast.Constant) and id(node) not in documentation
            if text and "`fic-sweep " in str(node.value):
                by_hand.add(path.relative_to(ROOT).as_posix())
    assert not by_hand
