"""How each kind of code block of a page is tried.

python    runs; all blocks of a page share their names
console   lines `$ command` run, in a folder of the page; the other lines are what they print.
          A page may leave out warnings, and all that a command prints
output    what the block above it prints; `...` stands for anything
toml      a sweep file, written into the folder as NAME.toml, or a part of one, which is checked
sh        commands that need another machine, hours or a network: names and options are checked
text, diff, yaml    are not run
"""

import doctest
import importlib.util
import io
import re
import shlex
import subprocess
import sysconfig
import tomllib
from contextlib import redirect_stdout
from pathlib import Path

import jax
import typer
from sybil import Example, Sybil
from sybil.parsers.markdown import CodeBlockParser

from sweeps.cli import app
from sweeps.spec.reading import load, validate
from tests.command import typed

ROOT = Path(__file__).parent.parent.parent
# how far a run is; a quick machine prints none
PROGRESS = re.compile(r"^[\d,]+ of (at most )?[\d,]+ \(.* left\n", re.MULTILINE)
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def python(example: Example) -> None:
    """Run a block as a file of its own; what it prints must stand below it."""
    nothing_unsaid(example)
    printed = io.StringIO()
    code = compile("\n" * example.line + example.parsed, example.path, "exec")
    with redirect_stdout(printed):
        exec(code, example.namespace)
    example.namespace["printed"] = printed.getvalue()


def output(example: Example) -> None:
    """Compare with what the last block printed."""
    compare(example.parsed, example.namespace.pop("printed", ""))


def nothing_unsaid(example: Example) -> None:
    """Whatever a block prints stands below it, where a reader looks for it."""
    assert not example.namespace.pop("printed", ""), f"line {example.line}: nobody shows the output"


def compare(wanted: str, got: str) -> None:
    checker = doctest.OutputChecker()
    sample = doctest.Example("", wanted)
    assert checker.check_output(wanted, got, FLAGS), checker.output_difference(sample, got, FLAGS)


def console(example: Example) -> None:
    """Run each command; it must print the lines below it, and fail only if these are an error."""
    nothing_unsaid(example)
    for part in re.split(r"^\$ ", example.parsed, flags=re.MULTILINE)[1:]:
        match = re.fullmatch(r"((?:.*\\\n)*.*)\n?((?s:.*))", part)
        assert match
        command, wanted = match.groups()
        code, out, err = run(command.replace("\\\n", " "))
        fails = re.match("fic-sweep: (?!warning)", wanted) is not None
        assert (code != 0) == fails, f"{command}\n{out}{err}"
        if wanted.strip():
            out = PROGRESS.sub("", out)
            compare(wanted, err + out if "fic-sweep: " in wanted else out)


def run(command: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command line."""
    words = shlex.split(command, comments=True)
    if words[0] == "fic-sweep":  # in this process, which has imported JAX
        pages = jax.config.jax_enable_x64
        try:
            ended = typed(*words[1:], configure=_in_precision)
        finally:
            jax.config.update("jax_enable_x64", pages)
        return ended.code, ended.stdout, ended.stderr
    path = {"PATH": f"{sysconfig.get_path('scripts')}:/usr/bin:/bin", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, shell=True, env=path, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout, done.stderr


def _in_precision(bits: int, *_: object) -> None:
    jax.config.update("jax_enable_x64", bits == 64)


def toml(example: Example) -> None:
    """Write a sweep file; complete a part of one, and check it."""
    raw = tomllib.loads(example.parsed)
    if "name" in raw:
        path = Path(f"{raw['name']}.toml")
        path.write_text(example.parsed, encoding="utf-8")
        load(path)
        return
    if not {"axes", "cases", "sample"} & raw.keys():
        raw["axes"] = {"Td": [1.0, 5.0]}
    validate({"name": "part"} | raw, f"{example.path}, line {example.line}")


def sh(example: Example) -> None:
    """Commands whose names and options exist; nothing runs."""
    script = example.parsed
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    commands = typer.main.get_command(app).commands
    lines = script.replace("\\\n", " ")
    for line in re.findall(r"^fic-sweep (.*)$", lines, re.MULTILINE):
        name, *arguments = shlex.split(line, comments=True)
        commands[name].make_context(name, arguments)
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    for target in re.findall(r"^make (\w+)", lines, re.MULTILINE):
        assert target in targets, target
    for module in re.findall(r"^python -m (\S+)", lines, re.MULTILINE):
        assert importlib.util.find_spec(module), module
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for extras in re.findall(r"(?:\.|fic-jax)\[([\w,]+)\]", lines):
        assert set(extras.split(",")) <= project["optional-dependencies"].keys(), extras


RUN = {
    "python": python,
    "output": output,
    "console": console,
    "toml": toml,
    "sh": sh,
    "bash": sh,
}
NOT_RUN = {"text", "diff", "yaml"}
SYBIL = Sybil([CodeBlockParser(language, evaluator) for language, evaluator in RUN.items()])
