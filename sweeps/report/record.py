"""What a report is made of: claims with evidence and computed verdicts, and sections beyond them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Evidence:
    """One quantity over a set of scenarios, and whether each of them is as the paper says."""

    quantity: str  # what was measured, with its unit
    values: np.ndarray  # [N]
    good: np.ndarray  # [N] bool: as claimed
    bound: str  # the claim in numbers, as "<= 1e-4"


@dataclass(frozen=True)
class Condition:
    """A part of the scenarios, in words: where a claim is asked whether it holds."""

    words: str  # "K0 <= 100 and Td <= Fmax"; empty: everywhere
    where: np.ndarray  # [N] bool


@dataclass(frozen=True)
class Section:
    """A finding beyond the paper's claims; every number in its text is computed."""

    title: str
    text: str  # Markdown paragraphs
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    figure: str  # stem of its picture
    command: str  # what makes it
