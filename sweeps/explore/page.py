"""One open page: its view, what it computes, what it shows.

The page's controls are HTML. Each sends an event, a line of JSON in the source `events`. The words
of the page come back as JSON in the source `words`, maps and motions as columns of Bokeh sources.
"""

import json
import math
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from html import escape
from threading import Lock
from typing import Any

from bokeh.document import Document
from bokeh.models import ColumnDataSource, CustomJS
from tornado.ioloop import IOLoop

from fic_jax import METRICS
from sweeps import maps
from sweeps.explore import source as sources
from sweeps.explore.cells import Map, label, symbol, text, unit
from sweeps.explore.motion import Motion, motion
from sweeps.explore.picture import MARKS, PALETTES, MapFigure, bar, colour_ends, shades
from sweeps.explore.server import body, text_of
from sweeps.explore.signals import drawn, look
from sweeps.explore.view import (
    History,
    Value,
    View,
    ViewError,
    changed,
    checked,
    parse,
    written,
)
from sweeps.explore.worker import Stale, Worker
from sweeps.spec.mistakes import SweepError
from sweeps.store.format import bound

LONGEST_EVENT = 4_000  # characters
REST = 400  # ms without an event, after which a view is one that `undo` comes back to
POLL = 1_000  # ms between two looks at a running sweep
MIDDLE = 0.5


class Page:
    """The state of an open page. `worker` computes maps, `quick` motions and values of cells."""

    def __init__(
        self, document: Document, source: sources.Source, worker: Worker, quick: Worker, query: str
    ) -> None:
        self.document, self.source, self.worker, self.quick = document, source, worker, quick
        self.closed, self.map, self.version = False, None, source.version
        self.loop = IOLoop.current()
        self._motions: dict[str, Motion] = {}
        self._pending: dict[str, Callable[[], None]] = {}
        self._lock = Lock()  # of what waits: a worker writes it, the page reads it
        self._rest: Any = None
        self.said: dict[str, Any] = {"notice": "", "maps": 0, "fine": False, "legend": []}
        self.said |= {"motions": [], "selected": None, "readout": None, "heard": 0}
        try:
            view = parse(query, source.start, source.space, source.defaults)
            source.check(view)
            self.view = source.opened(view)
        except ViewError as error:
            self.view = source.start
            self.said["notice"] = f"The address has no view that can be shown: {error}"
        self.history = History([self.view])
        self.figure = MapFigure()
        self.motions = ColumnDataSource(drawn([]), name="motions")
        self.words = ColumnDataSource({"json": [""]}, name="words")
        self.events = ColumnDataSource({"json": [""]}, name="events")
        self.events.on_change("data", self._receive)
        self.figure.figure.tags = [self.words, self.events, self.motions]
        for name in ("tap", "doubletap", "mousemove", "mouseleave"):
            pass_on = CustomJS(code="window.explorer && window.explorer.pointer(cb_obj)")
            self.figure.figure.js_on_event(name, pass_on)
        self.words.js_on_change("data", CustomJS(code="window.explorer && window.explorer.hear()"))
        with document.models.freeze():  # else Bokeh walks through the page after each
            document.add_root(self.figure.figure)
        document.js_on_event("connection_lost", CustomJS(code="window.explorer.lost()"))
        document.title = f"{source.title} - fic-sweep explore"
        document.template = body()
        document.template_variables.update(page_variables(source))
        document.on_session_destroyed(lambda _: self.close())
        if source.running:
            document.add_periodic_callback(self._poll, POLL)
        self._say()
        self._compute(first=True)

    map: Map | None

    def close(self) -> None:
        """Free the page's work."""
        self.closed = True
        for worker in (self.worker, self.quick):
            for what in ("map", "motion", "hover", "poll"):
                worker.drop((id(self), what))

    # ---- events

    def _receive(self, _attribute: str, _old: Any, new: Any) -> None:
        """An event of the page. A wrong one changes nothing and is answered by a notice."""
        try:
            event = _event(new)
            self.said["heard"] = event.pop("n")
            do = getattr(self, f"_on_{event.pop('do')}")
            do(**event)
        except (ViewError, SweepError) as error:
            self._say(notice=str(error))
        except Exception:
            traceback.print_exc()
            self._say(notice="The program has failed at this; its terminal has the reason.")

    def _on_ready(self) -> None:
        if not self.said["fine"]:
            self._compute()

    def _on_set(self, name: str, value: str) -> None:
        view = self.view
        if name in ("cell", "colours"):
            raise ViewError(f"`{name}` is set on the map.")
        if name in view.at:
            view = self.source.moved(view, name, self.source.space.value(name, value))
        else:
            view = changed(view, name, value, self.source.space)
        if name in ("metric", "how", "over", "level") or name.startswith("range."):
            view = replace(view, colours=None)
        self._go(view)

    def _on_axis(self, side: str, name: str) -> None:
        if side not in ("x", "y"):
            raise ViewError("an axis must be x or y.")
        changed(self.view, side, name, self.source.space)
        self._go(self.source.with_axis(self.view, side, name))

    def _on_tap(self, x: float, y: float, pin: bool = False) -> None:
        if self.map is None or not _same_axes(self.map.view, self.view):
            return
        row, column = self.map.cell(x, y)
        view = self.view
        again = view.cell and (row, column) == (
            self.map.y.index(view.cell[1]),
            self.map.x.index(view.cell[0]),
        )
        cell = view.cell if again else (self.map.x.value(column), self.map.y.value(row))
        if pin or again:
            view = view.pinned(self.source.place(view))
        self._select(view, cell)

    def _on_move(self, dx: float, dy: float) -> None:
        if self.map is None or not _same_axes(self.map.view, self.view):
            return
        x, y = self.map.x, self.map.y
        column, row = x.at(MIDDLE), y.at(MIDDLE)
        if self.view.cell:
            column, row = x.index(self.view.cell[0]) + int(dx), y.index(self.view.cell[1]) + int(dy)
        column = min(max(column, 0), len(x.values) - 1)
        row = min(max(row, 0), len(y.values) - 1)
        self._select(self.view, (x.value(column), y.value(row)))

    def _on_pin(self) -> None:
        self._select(self.view.pinned(self.source.place(self.view)), self.view.cell)

    def _on_unpin(self) -> None:
        self._select(replace(self.view, pins=()), self.view.cell)

    def _on_fit(self) -> None:
        self._go(replace(self.view, colours=None))

    def _on_undo(self) -> None:
        self._go(self.history.undo(self.view))

    def _on_hover(self, x: float, y: float) -> None:
        drawn = self.map
        if drawn is None:
            return
        row, column = drawn.cell(x, y)
        self.quick.submit((id(self), "hover"), lambda _: self._read(drawn, row, column))

    def _on_leave(self) -> None:
        self.quick.drop((id(self), "hover"))
        self._say(readout=self.said.get("selected"))

    def _read(self, drawn: Map, row: int, column: int) -> None:
        with suppress(OSError, ValueError):  # a damaged block: the map says it
            found = self._readout(drawn, row, column)
            self._later("hover", lambda: self._say(readout=found))

    # ---- computing

    def _go(self, view: View) -> None:
        """Show a view. Raises ViewError if it can't be computed."""
        self.source.check(checked(view))
        self.view = view
        self._compute()
        self._settle_later()

    def _compute(self, first: bool = False) -> None:
        """Compute map and motions; first of all the coarse map alone, until the page is there."""
        self.said["fine"] = False
        stages = self.source.stages()
        stages = stages[:1] if first else stages
        self.worker.submit((id(self), "map"), self._job(self.view, stages, None))
        self._move()

    def _job(self, view: View, stages: list[sources.Stage], before: Map | None) -> Any:
        (_, compute), *rest = stages

        def job(stale: Stale) -> None:
            try:
                found = compute(view, before, stale)
            except Exception as error:
                notice = _failure(error)
                self._later("map", lambda: self._say(notice=notice))
                return
            if found is not None:
                self._later("map", lambda: self._show(found))
                if rest:
                    following = self._job(view, rest, found)
                    self.worker.then((id(self), "map"), stale, following, rest[0][0])

        return job

    def _later(self, what: str, show: Callable[[], None]) -> None:
        """Show a result on the page's own thread; a newer one of its kind replaces it."""
        with self._lock:
            waits = what in self._pending
            self._pending[what] = show
        if not waits:
            # the server's thread may be making the page's session just now
            self.loop.add_callback(self._show_soon, what)

    def _show_soon(self, what: str) -> None:
        if not self.closed:
            self.document.add_next_tick_callback(lambda: self._show_pending(what))

    def _show_pending(self, what: str) -> None:
        with self._lock:
            show = self._pending.pop(what)
        show()

    def _show(self, found: Map) -> None:
        self.map = found
        now = _same_map(found.view, self.view)  # else a newer view is on its way
        if now and self.view.colours is None:
            self.view = replace(self.view, colours=colour_ends(found))
            if self.history.views[-1] == replace(self.view, colours=None):
                self.history.views[-1] = self.view
        ends = self.view.colours or colour_ends(found)
        self.figure.show(found, ends)
        self._mark()
        n = self.said["maps"] + 1
        fine = found.fine and now
        self.said["bar"] = bar(found.view.metric, *ends)
        self._say(legend=legend(found), title=_title(found), notice="", fine=fine, maps=n)

    def _mark(self) -> None:
        """Mark the selected cell and the pins that lie on the map."""
        if self.map is None:
            return
        places = [
            self._on_map(self.map, p) for p in (self.source.place(self.view), *self.view.pins)
        ]
        self.figure.mark(places)

    def _on_map(self, drawn: Map, place: Mapping[str, Value] | None) -> tuple[float, float] | None:
        if place is None or not _same_axes(drawn.view, self.view):
            return None
        x, y = drawn.x.centre(place[self.view.x]), drawn.y.centre(place[self.view.y])
        return None if x is None or y is None else (x, y)

    def _select(self, view: View, cell: tuple[Value, Value] | None) -> None:
        self.view = replace(view, cell=cell)
        self._mark()
        self._move()
        self._settle_later()

    def _move(self) -> None:
        """Simulate the selected cell and the pins."""
        view, places = self.view, [self.source.place(self.view), *self.view.pins]
        key = (id(self), "motion")
        if places == [None] and not self.said["motions"]:
            return
        if places == [None] or not self.source.has_motion:
            self.quick.drop(key)
            self.motions.data = drawn([])
            self._say(motions=[], selected=None, readout=None)
            if view.cell:
                self.quick.submit(key, lambda _: self._values_alone(view))
            return

        def job(stale: Stale) -> None:
            try:
                found = [place and self._motion(place) for place in places]
                words = self._words_of(view, found)
            except Exception as error:
                notice = _failure(error)
                self._later("motion", lambda: self._say(notice=notice))
                return
            if not stale():
                self._later("motion", lambda: self._draw(found, words))

        self.quick.submit(key, job)

    def _values_alone(self, view: View) -> None:
        """The values of a selected cell that has no motion."""
        place = self.source.place(view)
        if place:
            rows = self.source.values(place, {})
            words = {"at": _at(view, place), "rows": rows, "note": self.source.no_motion}
            self._later("motion", lambda: self._say(selected=words, readout=words))

    def _motion(self, place: Mapping[str, Value]) -> Motion:
        """The motion of a cell; those on the page are not simulated again."""
        key = json.dumps(dict(place), sort_keys=True)
        if key not in self._motions:
            self._motions[key] = motion(self.source.scenario(place))
            self._motions = dict(list(self._motions.items())[-2 * len(MARKS) :])
        return self._motions[key]

    def _words_of(self, view: View, found: list[Any]) -> dict[str, Any]:
        """The words about the motions, and the values of the selected cell."""
        places = [self.source.place(view), *view.pins]
        names = [n for n in view.at if len({p[n] for p in places if p}) > 1]
        names = names or [view.x, view.y]
        motions = []
        for i, (place, one) in enumerate(zip(places, found, strict=True)):
            if place and one:
                at = ", ".join(f"{n} = {_shown(place[n])}" for n in names)
                nmse = repr(float(one.metrics.nmse))
                motions.append({"mark": MARKS[i], "look": look(i), "at": at, "nmse": nmse})
        selected = None
        place = places[0]
        if place and found[0]:
            computed = {n: float(v) for n, v in asdict(found[0].metrics).items() if n in METRICS}
            rows = self.source.values(place, computed)
            note = self.source.disagreement(place, rows, computed) or found[0].note
            selected = {"at": _at(view, place, True), "rows": rows, "note": note}
        return {"motions": motions, "selected": selected, "readout": selected}

    def _draw(self, found: list[Any], words: dict[str, Any]) -> None:
        self.motions.data = drawn(found)
        self._say(**words)

    def _readout(self, drawn: Map, row: int, column: int) -> dict[str, Any]:
        """All values of a cell of the map."""
        view = drawn.view
        place = {**view.at, view.x: drawn.x.value(column), view.y: drawn.y.value(row)}
        known = {n: float(v[row, column]) for n, v in drawn.variables.items() if n in METRICS}
        rows = self.source.values(place, known)
        if view.over:
            rows = [[drawn.label, text(float(drawn.values[row, column])), drawn.unit, ""]]
        reason = drawn.words(row, column)
        return {"at": _at(view, place), "rows": rows, "note": reason}

    # ---- words

    def _say(self, **changes: Any) -> None:
        """Change the words of the page."""
        self.said |= changes
        view = self.view
        said = self.said | {
            "x": label(view.x),
            "y": label(view.y),
            "query": view.query(self.source.defaults),
            "view": {
                "metric": view.metric,
                "x": view.x,
                "y": view.y,
                "at": {n: written(v) for n, v in view.at.items()},
                "ranges": {n: [r.low, r.high, r.scale] for n, r in view.ranges.items()},
                "over": list(view.over),
                "how": view.how,
                "level": self.source.level(view),
                "cell": view.cell,
                "pins": len(view.pins),
            },
            "undo": len(self.history.views) > 1 or view != self.history.views[-1],
            "running": self.source.running,
        }
        self.words.data = {"json": [json.dumps(said, default=str)]}

    def _settle_later(self) -> None:
        """Keep this view for `undo`, unless another one comes soon."""
        if self._rest is not None:
            with suppress(ValueError):  # it has run
                self.document.remove_timeout_callback(self._rest)
        self._rest = self.document.add_timeout_callback(self._settle, REST)

    def _settle(self) -> None:
        self._rest = None
        self.history.settle(self.view)
        self._say()

    def _poll(self) -> None:
        """Look whether a running sweep has new blocks."""
        if self.source.running or self.version != self.source.version:
            self.quick.submit((id(self), "poll"), lambda _: self._look())

    def _look(self) -> None:
        try:
            self.source.poll()
        except (SweepError, OSError) as error:
            notice = _failure(error)
            self._later("poll", lambda: self._say(notice=notice))
            return
        if self.version != self.source.version:
            self.version = self.source.version
            self._later("poll", self._compute)


# event -> its values; each has its number `n` too
EVENTS: dict[str, dict[str, type]] = {
    "ready": {},
    "set": {"name": str, "value": str},
    "axis": {"side": str, "name": str},
    "tap": {"x": float, "y": float, "pin": bool},
    "hover": {"x": float, "y": float},
    "leave": {},
    "move": {"dx": float, "dy": float},
    "pin": {},
    "unpin": {},
    "fit": {},
    "undo": {},
}


def _event(columns: Any) -> dict[str, Any]:
    """The event that a page sends. Raises ViewError for anything else."""
    try:
        (line,) = columns["json"]
        if not isinstance(line, str) or len(line) > LONGEST_EVENT:
            raise ViewError(f"an event must be at most {LONGEST_EVENT:,} characters long.")
        event = json.loads(line)
        wanted = {"n": int} | EVENTS[event["do"]]
        given = {name: value for name, value in event.items() if name != "do"}
        for name, value in given.items():
            number = wanted[name] is float and type(value) in (int, float)
            if not (number or type(value) is wanted[name]) or (number and not math.isfinite(value)):
                raise ViewError(f"`{name}` of an event must be a {wanted[name].__name__}.")
        if wanted.keys() - given.keys() - {"pin"}:
            raise ViewError("an event lacks a value.")
        return dict(event)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        raise ViewError("the page has sent an event that is none.") from None


def _failure(error: Exception) -> str:
    """What the page says of an error; a fault of the program goes to the terminal too."""
    if isinstance(error, ViewError | SweepError):
        return str(error).splitlines()[0]
    if isinstance(error, OSError):
        return f"can't be read: {error}"
    traceback.print_exception(error)
    return f"The program has failed at this: {type(error).__name__}."


def _same_axes(one: View, other: View) -> bool:
    return (one.x, one.y) == (other.x, other.y)


def _same_map(one: View, other: View) -> bool:
    """Whether two views differ in their colours and chosen cells alone."""
    chosen: dict[str, Any] = {"colours": None, "cell": None, "pins": ()}
    return replace(one, **chosen) == replace(other, **chosen)


def _shown(value: Value) -> str:
    return maps.words(value) if isinstance(value, str) else f"{value:.6g}".replace("-", "−")


def _at(view: View, place: Mapping[str, Value], one: bool = False) -> list[list[str]]:
    """Name and value of the axes; of the reduced dimensions how they are, or those of one cell."""

    def shown(name: str) -> list[str]:
        return [symbol(name), f"{_shown(place[name])} {unit(name)}".strip()]

    over = [shown(name) if one else [symbol(name), f"{view.how} over all"] for name in view.over]
    return [shown(view.x), shown(view.y), *over]


def _title(drawn: Map) -> str:
    """HTML; label and unit are a store's."""
    label = escape(drawn.label + (f" ({drawn.unit})" if drawn.unit else ""))
    return f"<b>{escape(drawn.view.metric)}</b>: {label}"


def legend(drawn: Map) -> list[list[str]]:
    """Key and words of what has no colour, with its share of the cells."""
    words = {
        "not run": "not run yet",
        "not trusted": "no value: too many scenarios are not trusted",
        "infinite": maps.INFINITE.get(drawn.view.metric, "infinite"),
        "doubtful": "not trusted",
    }
    metric = drawn.view.metric
    if metric in METRICS:
        words["doubtful"] = f"not trusted: estimated error above {bound(metric)}"
    shares = [
        [key, f"{words.get(key, key)}, {_percent(part)}"] for key, part in drawn.shares.items()
    ]
    if drawn.converged is not None and 0 < drawn.converged.mean() < 1:
        shares.append(["border", f"converges inside, {_percent(float(drawn.converged.mean()))}"])
    return shares


def _percent(part: float) -> str:
    percent = 100 * part
    if 0 < percent < 0.1:
        return "<0.1 %"
    return f"{percent:.0f} %" if percent >= 10 or percent == 0 else f"{percent:.1f} %"


def page_variables(source: sources.Source) -> dict[str, Any]:
    """What the template needs: style, script, and the controls as JSON."""
    palettes = [shades(name).tolist() for name in PALETTES]
    about = source.controls() | {"palettes": palettes, "motion": source.has_motion}
    return {
        "script": text_of("page.drawing.js") + text_of("page.js"),
        "controls": json.dumps(about, default=str).replace("<", "\\u003c"),
        "heading": source.title,
    }
