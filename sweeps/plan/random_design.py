"""Random designs with random access: any stretch of a sample, the same in any chunks."""

import warnings
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from sweeps.spec.types import Sample

if TYPE_CHECKING:
    from scipy.stats import qmc


def draw(sample: Sample, start: int, stop: int) -> dict[str, np.ndarray]:
    """Values of each field of scenarios start..stop, from the seed alone."""
    fractions = _FRACTIONS[sample.method](sample, start, stop)
    spans = sample.ranges.items()
    return {name: span.at(u) for (name, span), u in zip(spans, fractions, strict=True)}


def _sobol(sample: Sample, start: int, stop: int) -> np.ndarray:
    """Scrambled Sobol points; balanced over a power of two, of which any stretch is drawn alone."""
    engine = _sobol_sequence(len(sample.ranges), sample.seed)
    if engine.num_generated > start:
        engine.reset()
    if engine.num_generated < start:  # scipy overflows on a forward of nothing
        engine.fast_forward(start - engine.num_generated)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The balance properties")  # a block is no whole design
        return engine.random(stop - start).T


@lru_cache(maxsize=1)  # forwarding takes time in proportion, but blocks come one after another
def _sobol_sequence(fields: int, seed: int) -> "qmc.Sobol":
    from scipy.stats import qmc  # a second to import, and few sweeps draw Sobol points

    return qmc.Sobol(fields, scramble=True, rng=seed, bits=32)


def _random(sample: Sample, start: int, stop: int) -> np.ndarray:
    return np.stack([_uniform(sample.seed, i, start, stop) for i in range(len(sample.ranges))])


def _lhs(sample: Sample, start: int, stop: int) -> np.ndarray:
    """Latin hypercube: each field's range cut in n strata, each stratum hit once."""
    rows = []
    for i in range(len(sample.ranges)):
        stratum = _strata(sample.n, sample.seed, i)[start:stop]
        rows.append((stratum + _uniform(sample.seed, i, start, stop)) / sample.n)
    return np.stack(rows)


@lru_cache(maxsize=32)  # one permutation a field, kept while a sweep runs through its blocks
def _strata(n: int, seed: int, field: int) -> np.ndarray:
    return np.random.default_rng([seed, field, 1]).permutation(n)


def _uniform(seed: int, field: int, start: int, stop: int) -> np.ndarray:
    """Draws start..stop of a counter-based stream; Philox makes four 64-bit words a count."""
    stream = np.random.Philox(np.random.SeedSequence([seed, field]))
    stream.advance(start // 4)
    skip = start % 4
    return np.random.Generator(stream).random(skip + stop - start)[skip:]


_FRACTIONS = {"sobol": _sobol, "random": _random, "lhs": _lhs}
