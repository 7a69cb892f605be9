"""The code in the README runs as printed."""

import re
import shlex
from pathlib import Path

import jax
import numpy as np
import pytest
import typer

from sweeps.cli import app
from sweeps.spec.reading import parse

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^fic-sweep (.*?)(?: +#.*)?$", README, re.MULTILINE)


def block(language, word):
    """The one block of code that contains a word."""
    blocks = re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)
    (found,) = (text for text in blocks if word in text)
    return found


def test_python_example():
    scope = {}
    exec(block("python", "rollout(p"), scope)
    assert scope["motion"].x.shape == (1000,)
    assert np.isfinite(scope["nmse"]).all()


@pytest.mark.parametrize("single", [True, False])
def test_control_on_an_own_plant_reaches_the_desired_torque(single):
    """Without strict promotion, as users have it; in float32 and in float64."""
    scope = {}
    with jax.numpy_dtype_promotion("standard"), jax.enable_x64(not single):
        exec(block("python", "control(p"), scope)
    torque = np.asarray(scope["torque"])
    assert torque.dtype == (np.float32 if single else np.float64)
    assert torque[-1] == pytest.approx(4.0, abs=0.05)


def test_toml_example_is_valid():
    dims = parse(block("toml", "[axes]"), "README").dims
    assert list(dims) == ["contact", "K0", "Kenv", "sigma", "case"]
    assert list(dims.values()) == [2, 64, 32, 3, 3]


def test_every_command_is_one_that_exists():
    """Names, options and the types of their values; nothing runs."""
    assert len(COMMANDS) > 10
    commands = typer.main.get_command(app).commands
    for line in COMMANDS:
        name, *arguments = shlex.split(line)
        commands[name].make_context(name, arguments)


def test_the_example_of_the_gradients_page_agrees_with_its_difference():
    page = (Path(__file__).parent.parent / "docs" / "gradients.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    scope = {}
    exec(example.replace("print(", "pair = ("), scope)
    gradient, difference = scope["pair"]
    assert gradient == pytest.approx(difference, rel=0.01)
