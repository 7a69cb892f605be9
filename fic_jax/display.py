"""Records as a reader sees them: a table in text, in a notebook in HTML."""

import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

WIDTH = 98  # columns of a line of text


@dataclass(frozen=True)
class Row:
    """A quantity: its name, its value as text, its unit and its meaning."""

    name: str
    value: str
    unit: str = ""
    meaning: str = ""

    @property
    def short(self) -> str:
        """Name, value and unit: `K0 = 100 N*m/rad`."""
        return f"{self.name} = {self.value} {self.unit}".rstrip()


@dataclass(frozen=True)
class Table:
    """A title, rows, and below them, shorter, the rows that a reader expects."""

    title: str
    rows: list[Row]
    expected: str = ""  # what is said of the shorter rows
    rest: list[Row] = field(default_factory=list)

    def text(self) -> str:
        """The table in lines of text."""
        cells = [(r.name, r.value, r.unit, r.meaning) for r in self.rows]
        widths = [max((len(row[i]) for row in cells), default=0) for i in range(3)]
        lines = [self.title]
        for row in cells:
            padded = [text.ljust(width) for text, width in zip(row, widths, strict=False) if width]
            lines.append("  " + "  ".join([*padded, row[3]]).rstrip())
        if self.rest:
            listed = ", ".join(row.short.replace(" ", "\xa0") for row in self.rest)
            wrapped = textwrap.wrap(
                f"{self.expected}: {listed}", WIDTH, subsequent_indent="  ", break_on_hyphens=False
            )
            lines += [line.replace("\xa0", " ") for line in wrapped]
        return "\n".join(lines)

    def html(self) -> str:
        """The table as HTML; the rest opens on a click."""
        rest = ""
        if self.rest:
            opened = "" if self.rows else " open"
            summary = f"<summary>{escape(self.expected)} ({len(self.rest)})</summary>"
            rest = f"<details{opened}>{summary}{_html(self.rest)}</details>"
        return f"<div><strong>{escape(self.title)}</strong>{_html(self.rows)}{rest}</div>"


def _html(rows: Iterable[Row]) -> str:
    left = ' style="text-align: left"'
    lines = [
        f"<tr><th{left}>{escape(r.name)}</th><td{left}>{escape(r.value)}</td>"
        f"<td{left}>{escape(r.unit)}</td><td{left}>{escape(r.meaning)}</td></tr>"
        for r in rows
    ]
    return f"<table><tbody>{''.join(lines)}</tbody></table>" if lines else ""


class Displayed:
    """A record that shows itself as the table that its `_table` makes."""

    def _table(self) -> Table:
        raise NotImplementedError

    def __repr__(self) -> str:
        return self._table().text()

    def __str__(self) -> str:  # before that of pydantic, in a sweep
        return repr(self)

    def _repr_html_(self) -> str:
        return self._table().html()


def row(name: str, value: Any, about: Mapping[str, str]) -> Row:
    """The row of a field that has unit and meaning."""
    unit = about["unit"]
    return Row(name, summary(value), "" if unit == "1" else unit, about["meaning"])


def summary(value: Any) -> str:
    """A number; of an array its shape and its range. Raises nothing, whatever the value is."""
    try:
        return _summary(value)
    except Exception:  # a deleted array, one of another process, a leaf that is no number
        try:
            return f"{value.dtype}{list(value.shape)}"
        except Exception:
            return type(value).__name__


def _summary(value: Any) -> str:
    if isinstance(value, jax.core.Tracer):
        return f"traced {jax.typeof(value).str_short()}"
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    # inside jit too, of an array that it does not trace; what is sent to a device is no data
    with jax.ensure_compile_time_eval(), jax.transfer_guard_host_to_device("allow"):
        if array.dtype == bool:
            n = int(jax.device_get(array.sum()))
            return f"{n:,} of {array.size:,} true" if array.ndim else str(bool(n))
        if not array.ndim:
            return f"{jax.device_get(array).item():.6g}"
        low, high = (f"{float(end):.4g}" for end in jax.device_get(_ends(array)))
    shape = " x ".join(f"{n:,}" for n in array.shape)
    return f"[{shape}] {low}" + (f" to {high}" if high != low else "")


def _ends(array: Any) -> tuple[Any, Any]:
    """The least and the largest number, computed where the array is; NaN only if all are."""
    if isinstance(array, jax.Array):
        return jnp.nanmin(array), jnp.nanmax(array)
    return np.fmin.reduce(array, axis=None), np.fmax.reduce(array, axis=None)


def is_default(value: Any, default: Any) -> bool:
    """Whether a value is one number, and the default to its own precision."""
    try:
        if isinstance(value, jax.core.Tracer) or np.ndim(value):
            return False
        number = jax.device_get(value)
        return bool(number == np.asarray(default, getattr(number, "dtype", np.float64)))
    except Exception:  # as in `summary`
        return False
