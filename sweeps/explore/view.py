"""What the explorer shows, as one record: in the browser's address, on a stack for undo."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self, get_args
from urllib.parse import parse_qsl, urlencode

from sweeps.spec.mistakes import hint, printable

Value = float | str
Scale = Literal["log", "lin"]
How = Literal["worst", "mean", "median", "share"]
HOWS: tuple[How, ...] = get_args(How)
MOST_PINS = 3  # motions beside the selected one; more lines can't be told apart
LONGEST_QUERY = 8_000  # characters; a server and a browser pass at least as many
MOST_VALUES = 100  # of a query: there are 15 fields, 7 choices and a few more
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


class ViewError(Exception):
    """A view that can't be shown; the text is one line."""


@dataclass(frozen=True)
class Range:
    """The ends of an axis and its scale."""

    low: float
    high: float
    scale: Scale


@dataclass(frozen=True)
class Space:
    """The names that a view may have, and what each may be."""

    metrics: tuple[str, ...]
    numbers: tuple[str, ...]  # names whose value is a number
    words: Mapping[str, tuple[str, ...]]  # names whose value is a word -> the words
    axes: tuple[str, ...]  # names that a map may be drawn over
    reducible: tuple[str, ...] = ()  # names that a reduction may go over
    live: bool = True  # whether axes have ranges

    def value(self, name: str, text: str) -> Value:
        """The value of a name. Raises ViewError."""
        if name in self.words:
            if text not in self.words[name]:
                allowed = ", ".join(self.words[name][:20])
                raise ViewError(f"`{name}` must be one of {allowed}, but is {printable(text)}.")
            return text
        if name not in self.numbers:
            known = hint(printable(name), [*self.numbers, *self.words])
            raise ViewError(f"unknown name `{printable(name)}`{known}")
        return number(name, text)


@dataclass(frozen=True)
class View:
    """A map and all that it depends on; of a store, `at` has a value of each dimension."""

    metric: str
    x: str
    y: str
    at: Mapping[str, Value]  # all that a slider or a list sets; the axes are not used
    ranges: Mapping[str, Range] = field(default_factory=dict)  # of axes without a store
    over: tuple[str, ...] = ()  # dimensions that are reduced
    how: How = "worst"
    level: float | None = None  # of the share: the metric is at most this
    colours: tuple[float, float] | None = None  # ends of the colours; None: not chosen yet
    cell: tuple[Value, Value] | None = None  # (x, y) of the cell whose motion is drawn
    pins: tuple[Mapping[str, Value], ...] = ()  # motions beside it: what each is at

    def place(self, cell: tuple[Value, Value] | None = None) -> dict[str, Value] | None:
        """What the selected cell is at, or another one: a value of each name; None without one."""
        cell = cell or self.cell
        return None if cell is None else {**self.at, self.x: cell[0], self.y: cell[1]}

    def pinned(self, here: Mapping[str, Value] | None) -> Self:
        """With a place among the pins, the oldest one gone if there are too many."""
        if here is None or here in self.pins:
            return self
        return replace(self, pins=(*self.pins, here)[-MOST_PINS:])

    def query(self, defaults: Mapping[str, Value]) -> str:
        """The view as the query of an address. `defaults` is what a pin leaves out."""
        pairs = [("metric", self.metric), ("x", self.x), ("y", self.y)]
        pairs += [(name, written(value)) for name, value in self.at.items()]
        pairs += [
            (f"range.{name}", f"{r.scale}:{r.low!r}:{r.high!r}") for name, r in self.ranges.items()
        ]
        if self.over:
            pairs += [("over", ",".join(self.over)), ("how", self.how)]
        if self.level is not None:
            pairs += [("level", repr(self.level))]
        if self.colours:
            pairs += [("colours", ":".join(map(repr, self.colours)))]
        if self.cell:
            pairs += [("cell", ":".join(map(written, self.cell)))]
        for pin in self.pins:
            own = [f"{n}:{written(v)}" for n, v in pin.items() if defaults.get(n) != v]
            pairs += [("pin", ",".join(own))]
        return urlencode(pairs, safe=":,")


def written(value: Value) -> str:
    """A value as in an address: the shortest text that gives it back."""
    return value if isinstance(value, str) else repr(float(value))


def number(name: str, text: str) -> float:
    """A finite number. Raises ViewError."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ViewError(f"`{printable(name)}` must be a finite number, but is {printable(text)}.")
    return value


def parse(query: str, start: View, space: Space, defaults: Mapping[str, Value]) -> View:
    """The view of an address; what the query does not name is as in `start`. Raises ViewError."""
    if len(query) > LONGEST_QUERY:
        raise ViewError(f"the address must have at most {LONGEST_QUERY:,} characters.")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, max_num_fields=MOST_VALUES)
    except ValueError:
        raise ViewError(f"the address must have at most {MOST_VALUES} values.") from None
    if not pairs:
        return start
    # an address with a view has all of it
    view = replace(start, cell=None, pins=(), colours=None, over=(), level=None)
    pins = [_pin(text, space, defaults) for key, text in pairs if key == "pin"]
    if len(pins) > MOST_PINS:
        raise ViewError(f"the address must have at most {MOST_PINS} pins, but has {len(pins)}.")
    for key, text in pairs:
        if key != "pin":
            view = changed(view, key, text, space)
    view = replace(view, pins=tuple(pins))
    if view.cell:
        cell = zip((view.x, view.y), map(written, view.cell), strict=True)
        x, y = (space.value(name, text) for name, text in cell)
        view = replace(view, cell=(x, y))
    return checked(view)


def changed(view: View, key: str, text: str, space: Space) -> View:
    """The view with one value of an address. Raises ViewError; `checked` is for the result."""
    name = key.removeprefix("range.")
    if key in ("metric", "x", "y"):
        names = space.metrics if key == "metric" else space.axes
        chosen: dict[str, Any] = {key: _one(key, text, names)}
        return replace(view, **chosen)
    if key != name and space.live:
        ranges = {**view.ranges, _one(key, name, space.axes): _range(key, text)}
        return replace(view, ranges=ranges)
    if key in _READ:
        return replace(view, **{key: _READ[key](text)})
    if key == "over":
        over = dict.fromkeys(filter(None, text.split(",")))
        return replace(view, over=tuple(_one(key, one, space.reducible) for one in over))
    return replace(view, at={**view.at, key: space.value(key, text)})


def with_axes(view: View, side: str, name: str) -> View:
    """The view with another axis; two axes that would be the same change places."""
    x, y = (name, view.y) if side == "x" else (view.x, name)
    if x == y:
        x, y = view.y, view.x
    return replace(view, x=x, y=y, cell=None, colours=None)


def checked(view: View) -> View:
    """The view, if its axes differ and are not reduced. Raises ViewError."""
    if view.x == view.y:
        raise ViewError(f"the axes must be two different ones, but both are `{view.x}`.")
    if gone := {view.x, view.y} & set(view.over):
        raise ViewError(f"`over` must not name an axis, but has `{min(gone)}`.")
    return view


def _one(key: str, text: str, names: Iterable[str]) -> str:
    names = list(names)
    if text not in names:
        raise ViewError(f"`{printable(key)}` has `{printable(text)}`{hint(printable(text), names)}")
    return text


def _how(text: str) -> How:
    for how in HOWS:
        if text == how:
            return how
    raise ViewError(f"`how` must be one of {', '.join(HOWS)}, but is {printable(text)}.")


def _range(key: str, text: str) -> Range:
    scale, *ends = text.split(":")
    if scale not in get_args(Scale) or len(ends) != 2:
        wanted = "log:LOW:HIGH or lin:LOW:HIGH"
        raise ViewError(f"`{printable(key)}` must be {wanted}, but is {printable(text)}.")
    low, high = (number(key, end) for end in ends)
    return Range(low, high, "log" if scale == "log" else "lin")


def _colours(text: str) -> tuple[float, float]:
    low, high = (number("colours", str(end)) for end in _pair("colours", text))
    if not low < high:
        raise ViewError(f"`colours` must be LOW:HIGH, but is {printable(text)}.")
    return low, high


def _pair(key: str, text: str) -> tuple[Value, Value]:
    parts = text.split(":")
    if len(parts) != 2:
        raise ViewError(f"`{key}` must be two values, A:B, but is {printable(text)}.")
    return parts[0], parts[1]


def _pin(text: str, space: Space, defaults: Mapping[str, Value]) -> dict[str, Value]:
    pin = dict(defaults)
    for part in filter(None, text.split(",")):
        name, _, value = part.partition(":")
        pin[name] = space.value(name, value)
    return pin


_READ: dict[str, Callable[[str], Any]] = {
    "how": _how,
    "level": lambda text: number("level", text),
    "colours": _colours,
    "cell": lambda text: _pair("cell", text),
}


@dataclass
class History:
    """The views that were shown, the present one last."""

    views: list[View]
    most: int = 100

    def settle(self, view: View) -> None:
        """Add a view at rest."""
        if view != self.views[-1]:
            self.views = [*self.views, view][-self.most :]

    def undo(self, now: View) -> View:
        """The view before the present one, or the present one if there is none."""
        if now == self.views[-1] and len(self.views) > 1:
            self.views.pop()
        return self.views[-1]
