"""The README's code runs as printed."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

from sweeps.plan.grid import Grid
from sweeps.spec.reading import parse

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
BLOCKS = {
    lang: re.findall(rf"```{lang}\n(.*?)```", README, re.DOTALL) for lang in ("python", "toml")
}


def test_python_example():
    scope = {}
    exec(BLOCKS["python"][1], scope)
    assert scope["motion"].x.shape == (1000,)
    assert np.isfinite(scope["nmse"]).all()


@pytest.mark.parametrize("single", [True, False])
def test_control_on_an_own_plant_reaches_the_desired_torque(single):
    """As a user runs it, strict promotion off; in float32 and in float64."""
    scope = {}
    with jax.numpy_dtype_promotion("standard"), jax.enable_x64(not single):
        exec(BLOCKS["python"][2], scope)
    torque = np.asarray(scope["torque"])
    assert torque.dtype == (np.float32 if single else np.float64)
    assert torque[-1] == pytest.approx(4.0, abs=0.05)


def test_toml_example_is_valid():
    (text,) = BLOCKS["toml"]
    assert Grid(parse(text, "README")).dims == {
        "contact": 2, "K0": 64, "Kenv": 32, "sigma": 3, "case": 3
    }  # fmt: skip
