"""A shared store as the text of one HTML file: data, record, style and script, and nothing else."""

import base64
import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from fic_jax import METRICS, QUANTITIES
from sweeps import maps
from sweeps.explore import texts
from sweeps.explore.cells import REASONS, Map, label, printed, text, unit
from sweeps.explore.picture import HATCHES, MARKS, PALETTES, bar, colour_ends, logarithmic, shades
from sweeps.explore.signals import look
from sweeps.explore.stored import Stored
from sweeps.explore.view import Value, View
from sweeps.share.coarse import MANTISSA, Copy
from sweeps.share.pins import Pin, middle
from sweeps.spec.mistakes import SweepError
from sweeps.store.format import bound
from sweeps.store.opening import Counts

MEGABYTE = 1_000_000  # bytes
ROOM = 200_000  # bytes for all but the copy: the page has 50,000, four motions up to 150,000


def page(
    source: Stored,
    copy: Copy,
    pins: Sequence[Pin],
    view: View,
    record: Sequence[tuple[str, str]],
    when: datetime,
) -> str:
    """The file. `record` says what the store is, in pairs of a head and a text.

    What comes from the store is escaped, and a policy in the page lets no other script run and
    nothing be loaded.
    """
    about = description(source, copy, pins, view)
    data = {**copy.encoded}
    for i, pin in enumerate(pins):
        data |= {f"pin-{i}-{name}": signal for name, signal in pin.signals.items()}
    style = _text("explore", "page.css") + _text("share", "page.css")
    script = _text("explore", "page.drawing.js") + _text("share", "page.js")
    return Template(_text("share", "page.html")).substitute(
        policy=f"default-src 'none'; img-src data:; script-src {_hash(script)}; "
        f"style-src {_hash(style)}",
        title=escape(source.title),
        style=style,
        script=script,
        lines="".join(f"<p>{escape(line)}</p>" for line in lines(source, copy)),
        record="".join(
            f"<dt>{escape(head)}</dt><dd>{escape(printed(words))}</dd>"
            for head, words in [*record, ("copied", f"{when:%Y-%m-%d}, by fic-sweep share")]
        ),
        sweep_file=escape(texts.sweep_file(source.grid.sweep).removeprefix(texts.STARTS)),
        no_motion="" if pins else escape(no_motion(source, view)),
        about=json.dumps(about).replace("<", "\\u003c"),
        data="\n".join(
            f'<script type="text/plain" id="{escape(name)}">{content}</script>'
            for name, content in data.items()
        ),
    )


def no_motion(source: Stored, view: View) -> str:
    """Why a page without pins has none."""
    if not source.has_motion:
        return source.no_motion
    return f"No cell of this copy has a trusted value of {view.metric}."


def _text(room: str, name: str) -> str:
    return files(f"sweeps.{room}").joinpath(name).read_text(encoding="utf-8")


def _hash(content: str) -> str:
    """What a content security policy names a script or a style by."""
    digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
    return f"'sha256-{digest}'"


def lines(source: Stored, copy: Copy) -> list[str]:
    """What the copy lacks of the store, in sentences."""
    whole = source.grid.cells
    parts = [
        f"every {_ordinal(k)} of {source.grid.dims[dim]:,} values of {dim}"
        for dim, k in copy.strides.items()
        if k > 1
    ]
    said = f"All {whole:,} cells of the store."
    if parts:
        said = (
            f"A copy of {copy.cells:,} cells: {', '.join(parts)}, the first, the last and those of "
            f"pinned cells too. The whole store has {whole:,} cells. Nothing is averaged."
        )
    digits = "as in the store" if source.dtype == "float32" else "in single precision, 7 digits"
    if copy.bits < MANTISSA:
        digits = "rounded to 4 digits"
    found = [f"{said} Numbers are {digits}."]
    left, own = len(Counts.of(source.store).pending), len(source.grid.own)
    if left:
        found.append(
            f"The sweep was not finished when it was copied: {left:,} of {own:,} blocks "
            "are missing."
        )
    if shard := source.grid.shard:
        found.append(f"This is shard {shard} of a sweep: the cells of the others are not run here.")
    return found


def _ordinal(n: int) -> str:
    ending = {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th") if n // 10 % 10 != 1 else "th"
    return f"{n:,}{ending}"


def description(source: Stored, copy: Copy, pins: Sequence[Pin], view: View) -> dict[str, Any]:
    """All that the script needs beside the arrays."""
    first = places(copy, pins[0]) if pins else middle(copy)
    return {
        "start": {"metric": view.metric, "x": view.x, "y": view.y, "at": first},
        "metrics": [_metric(source, copy, name) for name in copy.metrics],
        "dims": [_dimension(source, copy, dim) for dim in copy.kept],
        "reasons": REASONS,
        "looks": HATCHES,
        "palettes": [shades(name).tolist() for name in PALETTES],
        "digits": 4 if copy.bits < MANTISSA else 5,
        "converged": copy.converged is not None,
        "pins": [
            {
                "name": pin.name,
                "at": places(copy, pin),
                "where": [
                    f"{dim} = {shown_value(source, dim, k)}"
                    for dim, k in zip(copy.kept, pin.index, strict=True)
                ],
                "nmse": pin.nmse,
                "note": pin.note,
                "Td": float(pin.motion.scenario.params.Td),
                "gap": float(pin.motion.scenario.params.gap),
                "mark": mark,
                "look": look(i),
            }
            for i, (pin, mark) in enumerate(zip(pins, MARKS, strict=False))
        ],
    }


def places(copy: Copy, pin: Pin) -> dict[str, int]:
    """Where a pin is along the dimensions of a copy."""
    return {
        dim: kept.tolist().index(i)
        for (dim, kept), i in zip(copy.kept.items(), pin.index, strict=True)
    }


def shown_value(source: Stored, dim: str, i: int) -> str:
    """A value of a dimension in words, with its unit; of a case all its values."""
    found = source.grid.coordinates(dim, slice(i, i + 1))
    own = {name: _plain(values[0]) for name, values in found.items() if name != "case"}
    if dim == "case":
        return f"{i} ({', '.join(f'{n} = {_with_unit(n, v)}' for n, v in own.items())})"
    return _with_unit(dim, own[dim])


def _with_unit(name: str, value: Value) -> str:
    return f"{text(value)} {unit(name)}".strip()


def _plain(value: Any) -> Value:
    return str(value) if isinstance(value, str) else float(value)


def _metric(source: Stored, copy: Copy, name: str) -> dict[str, Any]:
    """Words, colours and ticks of a metric; the colours suit the whole copy."""
    attrs = source.store.array(name).attrs
    metric, axis = copy.metrics[name], next(iter(copy.axes.values()))
    flat = metric.values.reshape(1, -1)
    codes = (~metric.known).astype(flat.dtype).astype("u1").reshape(1, -1)
    view = replace(source.start, metric=name)
    low, high = colour_ends(Map(view, axis, axis, flat, codes, "", ""))
    doubt = f": estimated error above {bound(name)}" if name in METRICS else ""
    return {
        "name": name,
        "label": str(attrs["long_name"]),
        "unit": printed(str(attrs["units"])),
        "low": low,
        "high": high,
        "log": logarithmic(name, low, high),
        **bar(name, low, high),
        "words": {
            "not run": "not run yet",
            "not trusted": "no value: too many scenarios are not trusted",
            "infinite": maps.INFINITE.get(name, "infinite"),
            "doubtful": f"not trusted{doubt}",
        },
    }


def _dimension(source: Stored, copy: Copy, dim: str) -> dict[str, Any]:
    """Words, values, edges and ticks of a dimension."""
    axis = copy.axes[dim]
    meaning = QUANTITIES.get(dim, {"meaning": f"{dim} of the sweep"})["meaning"]
    return {
        "name": dim,
        "label": label(escape(dim)),
        "meaning": meaning,
        "texts": [shown_value(source, dim, int(i)) for i in copy.kept[dim]],
        "edges": [round(float(place), 7) for place in axis.places],
        "ticks": [[round(place, 7), words] for place, words in axis.ticks()],
        "words": not axis.numeric,
    }


def check_size(content: str, megabytes: float) -> bytes:
    """The file in bytes. Raises SweepError if it is larger than it may be."""
    found = content.encode()
    if len(found) > megabytes * MEGABYTE:
        raise SweepError(
            f"--size {megabytes:g}: must be at least {math.ceil(len(found) / 1e5) / 10:g} MB"
        )
    return found


def room_for_copy(megabytes: float) -> int:
    """Bytes that a file has for the copy. Raises SweepError if there are none."""
    if not ROOM < megabytes * MEGABYTE < math.inf:
        raise SweepError(
            f"--size {megabytes:g}: must be more than {ROOM / MEGABYTE:g} MB, which is "
            "reserved for all but the data"
        )
    return int(megabytes * MEGABYTE) - ROOM
