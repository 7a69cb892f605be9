"""A copy of a store that fits into a file: fewer digits, then fewer values of the longest axes."""

import base64
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweeps.explore.cells import Axis, reasons
from sweeps.explore.stored import STATUS, Stored
from sweeps.spec.mistakes import SweepError
from sweeps.store.format import ERRORS, JUDGEMENTS, NOT_TRUSTED, OK, OLD_JUDGEMENTS

MANTISSA = 23  # bits of a number in single precision
KEPT_BITS = 13  # of them: a relative error of at most 2**-14 = 6e-5, which keeps 4 digits
LEAST_VALUES = 5  # of an axis; a map of fewer shows no course
DENSEST = 0.25  # of the bytes of numbers that deflate leaves at best, but of constants
DOUBT = 128  # of a code: the cell is not trusted
EXPANSION = 4 / 3  # of base64


@dataclass(frozen=True)
class Metric:
    """A metric in the cells of a copy."""

    values: NDArray[np.float32]
    codes: NDArray[np.uint8]  # index of REASONS; DOUBT is added where it is not trusted

    @property
    def known(self) -> NDArray[np.bool_]:
        """The cells that have a number."""
        return (self.codes & ~np.uint8(DOUBT)) == 0


@dataclass(frozen=True)
class Copy:
    """Cells of a store, along each dimension in the order of its axis."""

    strides: Mapping[str, int]  # dimension -> every how many values
    kept: Mapping[str, NDArray[np.intp]]  # dimension -> index in the store
    axes: Mapping[str, Axis]
    metrics: Mapping[str, Metric]
    converged: NDArray[np.bool_] | None  # None: the store does not say
    bits: int  # of the mantissas

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(len(kept) for kept in self.kept.values())

    @cached_property
    def encoded(self) -> dict[str, str]:
        """Each array of the copy as text, by the name of its element in the page."""
        found = {}
        for name, metric in self.metrics.items():
            found[f"values-{name}"] = encoded(rounded(metric.values, self.bits))
            found[f"codes-{name}"] = encoded(metric.codes)
        if self.converged is not None:
            found["converged"] = encoded(self.converged.astype(np.uint8))
        return found

    @property
    def size(self) -> int:
        """Bytes of the copy in a file."""
        return sum(map(len, self.encoded.values()))


def copied(
    source: Stored, metrics: Sequence[str], pinned: Sequence[tuple[int, ...]], most: int
) -> Copy:
    """Some metrics of a store in at most so many bytes; the cells `pinned` are among them.

    All digits and all cells if they fit, else 4 digits, else every k-th value of the longest axes,
    their first and last ones too. Nothing is averaged. Raises SweepError if even LEAST_VALUES of
    each axis do not fit.
    """
    cells = source.grid.cells
    raw = cells * len(metrics) * 4 * EXPANSION
    bits = MANTISSA if DENSEST * raw <= most else KEPT_BITS
    # a first guess that is not too small; what is read is then measured
    wanted = min(cells, int(cells * most / (DENSEST / 2 * raw)))
    smallest = strides(source, 0)
    while True:
        chosen = strides(source, wanted)
        copy = read(source, metrics, chosen, pinned, bits)
        if copy.size > most and bits == MANTISSA:
            bits = KEPT_BITS
            copy = replace(copy, bits=bits)
        if copy.size <= most:
            return copy
        if chosen == smallest:
            raise SweepError(
                f"{source.path}: its smallest copy needs {copy.size / 1e6:.2g} MB beside the page, "
                f"and {most / 1e6:.2g} MB are left: raise --size, or name fewer metrics"
            )
        wanted = min(int(0.97 * copy.cells * most / copy.size), copy.cells - 1)


def strides(source: Stored, most: int) -> dict[str, int]:
    """Strides that leave at most so many cells, if LEAST_VALUES of each axis allow it.

    A step makes the longest axis shorter. Lists of choices and cases stay whole.
    """
    n, found = source.grid.dims, dict.fromkeys(source.grid.dims, 1)
    long = [dim for dim in source.grid.sweep.axes if dim in n]
    while math.prod(count(n[dim], k) for dim, k in found.items()) > most:
        longest = max(long, key=lambda dim: count(n[dim], found[dim]), default="")
        if not longest or count(n[longest], found[longest]) <= LEAST_VALUES:
            break
        # the next stride that leaves fewer values
        left = count(n[longest], found[longest]) - 2
        found[longest] = -(-(n[longest] - 1) // left)
    return found


def count(n: int, stride: int) -> int:
    """Number of n values that a stride leaves, with the last one."""
    return -(-(n - 1) // stride) + 1


def read(
    source: Stored,
    metrics: Sequence[str],
    chosen: Mapping[str, int],
    pinned: Sequence[tuple[int, ...]],
    bits: int,
) -> Copy:
    """The cells that strides leave, and those that have a coordinate of a pinned cell."""
    kept, axes = {}, {}
    for i, (dim, values) in enumerate(source.coordinates.items()):
        n, own = len(values), [cell[i] for cell in pinned]
        kept[dim] = np.unique([*range(0, n, chosen[dim]), n - 1, *own])
        axis = source.axes[dim]
        if axis.scale != "category":
            kept[dim] = kept[dim][np.argsort(values[kept[dim]])]
        axes[dim] = Axis(dim, axis.scale, values[kept[dim]])

    def cells(name: str) -> NDArray[Any]:
        index = tuple(np.sort(one) for one in kept.values())
        found = np.asarray(source.store.array(name).oindex[index])
        for side, one in enumerate(kept.values()):
            if one.size > 1 and one[0] > one[1]:
                found = np.flip(found, side)
        return np.ascontiguousarray(found)

    status = cells("status")
    converged = None
    if source.has_motion and "convergence_time" in source.store.variables:
        converged = np.isfinite(cells("convergence_time"))
    return Copy(
        strides=dict(chosen),
        kept=kept,
        axes=axes,
        metrics={name: _metric(source, name, status, cells) for name in metrics},
        converged=converged,
        bits=bits,
    )


def _metric(source: Stored, name: str, status: NDArray[Any], cells: Any) -> Metric:
    values = cells(name)
    if own := str(source.store.array(name).attrs.get("ancillary_variables", "")):
        status = np.where(status == OK, cells(own), status)
    codes = reasons(values, status, STATUS)
    judged = ERRORS.get(name, name)
    flags = [flag for flag, of in (JUDGEMENTS | OLD_JUDGEMENTS).items() if of == judged]
    flag = next((flag for flag in flags if flag in source.store.variables), None)
    if flag is not None:
        codes += np.uint8(DOUBT) * (cells(flag) == NOT_TRUSTED)
    largest = np.finfo(np.float32).max  # a finite number stays finite in single precision
    finite = np.isfinite(values)
    values = np.where(finite, np.clip(values, -largest, largest), values)
    return Metric(values.astype(np.float32), codes)


def rounded(values: NDArray[np.float32], bits: int) -> NDArray[np.float32]:
    """Numbers with so many bits of their mantissas, rounded to the nearest, ties to even."""
    gone = MANTISSA - bits
    if gone == 0:
        return values
    word = values.view(np.uint32)
    half = np.uint32((1 << (gone - 1)) - 1) + ((word >> np.uint32(gone)) & np.uint32(1))
    found = ((word + half) & np.uint32(~((1 << gone) - 1) & 0xFFFFFFFF)).view(np.float32)
    return np.where(np.isfinite(values) & np.isfinite(found), found, values)


def encoded(array: NDArray[Any]) -> str:
    """An array as base64 of deflated bytes: all first bytes, all second ones, and so on."""
    bytes_ = np.ascontiguousarray(array).view(np.uint8).reshape(array.size, -1)
    return base64.b64encode(zlib.compress(np.ascontiguousarray(bytes_.T).tobytes(), 6)).decode()
