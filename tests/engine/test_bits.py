"""Regression only: the bits of sweeps are those recorded under this numerics version.

They depend on the arithmetic (fused or unfused multiply-adds) and on nothing else: not on the width
of the registers. `make torture` compares every reading of the model.
"""

import json

import pytest

from fic_jax.engine import arithmetic
from tests.engine import bits
from tests.torture import many

CASES = list(bits.cases())
# in `make test`: every option, both precisions, error estimates
CHOSEN = [case for i, case in enumerate(CASES) if i % 31 == 0 or "estimate" in case[0]]


@pytest.mark.parametrize("case", many(CHOSEN, CASES), ids=lambda case: case[0])
def test_the_bits_are_those_recorded(case):
    recorded = json.loads(bits.GOLDEN.read_text()).get(arithmetic())
    if recorded is None:
        pytest.skip(f"no bits are recorded for {arithmetic()}")
    name, *scenario = case
    assert bits.digest(*scenario) == recorded[name]


def test_the_chosen_readings_have_every_option():
    words = {word for name, *_ in CHOSEN for word in name.replace(" ", "-").split("-")}
    assert words >= {word for name, *_ in CASES for word in name.replace(" ", "-").split("-")}
