"""Random designs: the values of scenarios start..stop depend on the seed, never on the block."""

import warnings
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from sweeps.spec.types import RandomDesign

if TYPE_CHECKING:
    from scipy.stats import qmc


def draw(design: RandomDesign, start: int, stop: int) -> dict[str, np.ndarray]:
    """Field -> its values in scenarios start..stop."""
    fractions = _METHODS[design.method](design, start, stop)
    fields = zip(design.ranges.items(), fractions, strict=True)
    return {name: values.at(fraction) for (name, values), fraction in fields}


def _sobol(design: RandomDesign, start: int, stop: int) -> np.ndarray:
    """Fractions [field, scenario]: scrambled Sobol points, balanced over each power of two."""
    sequence = _sobol_sequence(len(design.ranges), design.seed)
    if sequence.num_generated > start:
        sequence.reset()
    if sequence.num_generated < start:  # fast_forward(0) overflows in scipy
        sequence.fast_forward(start - sequence.num_generated)
    with warnings.catch_warnings():
        # scipy warns if one call is no power of two; the whole design may well be
        warnings.filterwarnings("ignore", "The balance properties")
        return sequence.random(stop - start).T


@lru_cache(maxsize=1)  # fast_forward takes time with the distance, and blocks come in order
def _sobol_sequence(fields: int, seed: int) -> "qmc.Sobol":
    from scipy.stats import qmc  # takes a second to import, and few sweeps need it

    return qmc.Sobol(fields, scramble=True, rng=seed, bits=32)


def _random(design: RandomDesign, start: int, stop: int) -> np.ndarray:
    """Fractions [field, scenario]: independent and uniform."""
    fields = range(len(design.ranges))
    return np.stack([_uniform(design.seed, field, start, stop) for field in fields])


def _lhs(design: RandomDesign, start: int, stop: int) -> np.ndarray:
    """Fractions [field, scenario]: Latin hypercube, one scenario in each of a field's n strata."""
    rows = []
    for field in range(len(design.ranges)):
        stratum = _strata(design.n, design.seed, field)[start:stop]
        rows.append((stratum + _uniform(design.seed, field, start, stop)) / design.n)
    return np.stack(rows)


@lru_cache(maxsize=32)  # every block of a run needs the permutation of every field
def _strata(n: int, seed: int, field: int) -> np.ndarray:
    return np.random.default_rng([seed, field, 1]).permutation(n)


def _uniform(seed: int, field: int, start: int, stop: int) -> np.ndarray:
    """Numbers start..stop of a field's stream. Philox counts in steps of four 64-bit numbers."""
    stream = np.random.Philox(np.random.SeedSequence([seed, field]))
    stream.advance(start // 4)
    skip = start % 4
    return np.random.Generator(stream).random(skip + stop - start)[skip:]


_METHODS = {"sobol": _sobol, "random": _random, "lhs": _lhs}
