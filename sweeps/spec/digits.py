"""How many digits of a number to print."""

from collections.abc import Iterable

import numpy as np

LEAST = 4  # significant digits of a value whose neighbours are far away
# A decimal of at most so many digits was written by a person, and is printed whole.
WRITTEN = 8
MOST = 17  # no two numbers in double precision are alike in so many


def digits(values: Iterable[float], least: int = LEAST) -> int:
    """Significant digits that tell values apart, and print those that are short decimals whole.

    With n = digits(values), `f"{value:.{n}g}"` differs for any two values that differ.
    """
    finite = np.unique([value for value in map(float, values) if np.isfinite(value)])
    n = max([least, *(len(w) for w in map(_significand, finite) if len(w) <= WRITTEN)])
    low, high = finite[:-1], finite[1:]
    while n < MOST and low.size:
        # a rounded pair stays in order: if no neighbours are alike, no two values are
        alike = [f"{a:.{n}g}" == f"{b:.{n}g}" for a, b in zip(low, high, strict=True)]
        low, high = low[alike], high[alike]
        n += bool(low.size)
    return n


def _significand(value: float) -> str:
    """The digits of a number as it is written: 10025 of 1000.25 (15: more are its rounding)."""
    return f"{value:.14e}".partition("e")[0].lstrip("-").replace(".", "").rstrip("0")
