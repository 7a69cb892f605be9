"""Maps without a store: a view becomes a sweep, and each movement of a slider runs it anew."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fic_jax import CHOICES, METRICS, QUANTITIES, Model, Params, sweep
from sweeps import maps
from sweeps.explore import texts
from sweeps.explore.cells import Axis, Doubt, Map, Row, label, printed, reasons, row, unit
from sweeps.explore.motion import Scenario
from sweeps.explore.source import Stage
from sweeps.explore.view import Range, Space, Value, View, ViewError, with_axes
from sweeps.explore.worker import Stale
from sweeps.plan.grid import Grid
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import validate
from sweeps.spec.types import STORED, Sweep, Time
from sweeps.store.commit import values_of
from sweeps.store.format import DIVERGED, NOT_TRUSTED

if TYPE_CHECKING:
    import xarray as xr

COARSE, FINE = 64, 256  # cells of a side while a slider moves, and when it rests
REST = 0.15  # s without an event, after which a slider rests
# Steps computed at once, some 12 ms on two cores; a newer event then comes first.
BAND = 4_096_000
MOST_STEPS = 200_000  # of a scenario: a coarse map then takes some seconds
NAME = "explored"  # of the sweep
TITLE = "Fractal Impedance Controller"
TIMES = {"dt": "plant step", "t_end": "end of the run"}
STATUS = {DIVERGED: "diverged"}
_SCALES = {"log": "log", "lin": "linear"}


def defaults() -> dict[str, Value]:
    """The paper's values and choices, and the time grid of a sweep file that names none."""
    fields = {name: float(value) for name, value in vars(Params()).items()}
    times = {name: float(getattr(Time(), name)) for name in TIMES}
    return {**fields, **{name: getattr(Model(), name) for name in CHOICES}, **times}


def span(name: str) -> Range:
    """Where a slider of a field goes: a decade to each side of its default, -1 to 1 around zero."""
    default = float(getattr(Params(), name))
    if default == 0:
        return Range(-1.0, 1.0, "lin")
    return Range(float(f"{default / 10:.2g}"), float(f"{default * 10:.2g}"), "log")


def includes_zero(name: str) -> bool:
    """Whether a slider on a log scale has zero at its lower end."""
    return bool(QUANTITIES[name]["bound"] == "non-negative")


SPACE = Space(
    metrics=STORED,
    numbers=(*QUANTITIES, *TIMES),
    words=CHOICES,
    axes=tuple(QUANTITIES),
)


@dataclass(frozen=True)
class Live:
    """Maps of the program itself, beginning with a sweep or with the paper's values."""

    sweep: Sweep | None = None
    dtype: str = "float32"

    space = SPACE
    has_motion, no_motion = True, ""
    running, version = False, 0

    @property
    def title(self) -> str:
        return self.sweep.description or self.sweep.name if self.sweep else TITLE

    @property
    def defaults(self) -> dict[str, Value]:
        return defaults()

    @property
    def spans(self) -> dict[str, Range]:
        """The ends of each field's slider."""
        return {name: span(name) for name in QUANTITIES} | self._swept()

    def _swept(self) -> dict[str, Range]:
        """The ends of what the sweep varies."""
        found = {}
        if self.sweep:
            for name in (*self.sweep.axes, *self.sweep.cases, *self._drawn()):
                axis = self.sweep.axes.get(name) or self._drawn().get(name)
                ends = self.sweep.outermost(name)
                low, high = float(ends.min()), float(ends.max())
                wide = low > 0 and high > 10 * low
                log = bool(getattr(axis, "log", None)) or (isinstance(axis, list) and wide)
                if low < high:
                    found[name] = Range(low, high, "log" if log else "lin")
        return found

    def _drawn(self) -> Mapping[str, Any]:
        return self.sweep.sample.ranges if self.sweep and self.sweep.sample else {}

    @property
    def start(self) -> View:
        """The view that an address without a query shows."""
        at, swept = defaults(), self._swept()
        x, y = "Kenv", "K0"
        if self.sweep:
            held = self.sweep.held()
            at |= held | {"dt": self.sweep.time.dt, "t_end": self.sweep.time.t_end}
            first = {n: c[0] for n, c in self.sweep.model.items() if isinstance(c, list)}
            at |= first | {name: column[0] for name, column in self.sweep.cases.items()}
            at |= {name: self._middle(name) for name in (*self.sweep.axes, *self._drawn())}
            y, x = [*swept, *(name for name in (y, x) if name not in swept)][:2]
        metrics = self.sweep.metrics if self.sweep else ["nmse"]
        ranges = {name: swept.get(name, span(name)) for name in (x, y)}
        return View("nmse" if "nmse" in metrics else metrics[0], x, y, at, ranges)

    def _middle(self, name: str) -> float:
        assert self.sweep
        if name in self.sweep.axes:
            values = self.sweep.axis_values(name)
            return float(values[len(values) // 2])
        return float(self._drawn()[name].at(np.array([0.5]))[0])

    def opened(self, view: View) -> View:
        """The view of an address: any values can be shown."""
        return view

    def moved(self, view: View, name: str, value: Value) -> View:
        """The view with another value; `period` becomes a multiple of dt."""
        at = {**view.at, name: value}
        dt = float(at["dt"])
        if name in ("period", "dt") and dt > 0:
            at["period"] = float(f"{max(round(float(at['period']) / dt), 1) * dt:.12g}")
        return replace(view, at=at)

    def with_axis(self, view: View, side: str, name: str) -> View:
        """The view with another axis; two axes that would be the same change places."""
        view = with_axes(view, side, name)
        known = self.spans | dict(view.ranges)
        return replace(view, ranges={name: known[name] for name in (view.x, view.y)})

    def plan(self, view: View, n: int) -> Sweep:
        """The sweep whose cells a map of n x n cells shows. Raises ViewError."""
        return self._plan(view.at, {name: _axis(view, name, n) for name in (view.y, view.x)})

    def _plan(self, at: Mapping[str, Value], axes: Mapping[str, Any]) -> Sweep:
        bits = int(self.dtype.removeprefix("float"))
        raw: dict[str, Any] = {
            "name": NAME,
            "time": {name: at[name] for name in TIMES},
            "model": {name: at[name] for name in CHOICES},
            "constants": {name: at[name] for name in QUANTITIES if name not in axes},
            "axes": dict(axes),
        }
        raw |= {"precision": bits} if bits != 32 else {}
        try:
            return validate(raw, "this view")
        except SweepError as error:
            line = str(error).splitlines()[0].removeprefix("this view: ")
            for table in ("constants.", "axes.", "time.", "model."):
                line = line.replace(f"`{table}", "`")
            raise ViewError(line) from None

    def poll(self) -> None:
        """Nothing runs elsewhere."""

    def level(self, view: View) -> float:
        """No share is shown."""
        del view
        return 0.0

    def values(self, place: Mapping[str, Value], known: Mapping[str, float]) -> list[Row]:
        """The metrics of a cell as rows of text."""
        del place
        return [row(name, known[name], METRICS[name]["unit"]) for name in STORED]

    def disagreement(
        self, place: Mapping[str, Value], rows: list[Row], computed: Mapping[str, float]
    ) -> str:
        """The map and the motion are of one program."""
        del rows, computed
        return ""

    def controls(self) -> dict[str, Any]:
        """What the page's controls are."""
        fields = [
            {"name": n, "label": label(n), "meaning": about["meaning"], "unit": unit(n)}
            | dataclasses.asdict(self.spans[n])
            | {"zero": includes_zero(n) and self.spans[n].scale == "log"}
            for n, about in QUANTITIES.items()
        ]
        choices = [
            {"name": n, "options": [[option, maps.words(option)] for option in options]}
            for n, options in CHOICES.items()
        ]
        return {
            "live": True,
            "metrics": [[n, f"{n}: {METRICS[n]['meaning']}"] for n in STORED],
            "axes": [[n, f"{n}: {about['meaning']}"] for n, about in QUANTITIES.items()],
            "fields": fields,
            "choices": choices,
            "times": [[n, meaning] for n, meaning in TIMES.items()],
        }

    def check(self, view: View) -> None:
        """Raise ViewError if the view can't be computed."""
        steps = self.plan(view, COARSE).n_steps
        if steps > MOST_STEPS:
            raise ViewError(
                f"`t_end` must be at most {MOST_STEPS:,} times `dt` in a live map, but is "
                f"{steps:,} times. A sweep that is run has no such limit."
            )

    def stages(self) -> list[Stage]:
        """What computes a map, coarse then fine, each after a delay; None if it became stale."""
        return [(0.0, self._coarse), (REST, self._fine), (0.0, self._with_doubt)]

    def _coarse(self, view: View, _: Map | None, stale: Stale) -> Map | None:
        return self.map(view, COARSE, stale)

    def _fine(self, view: View, _: Map | None, stale: Stale) -> Map | None:
        return self.map(view, FINE, stale)

    def _with_doubt(self, view: View, before: Map | None, stale: Stale) -> Map | None:
        estimated = self.map(view, COARSE, stale, error_estimate=True)
        return estimated and before and replace(before, doubt=estimated.doubt)

    def map(
        self, view: View, n: int, stale: Stale = lambda: False, error_estimate: bool = False
    ) -> Map | None:
        """The map of a view, n x n cells; None if it became stale meanwhile. Raises ViewError."""
        plan = self.plan(view, n)
        grid = Grid(plan)
        rows, columns = grid.shape
        bands: list[Mapping[str, NDArray[Any]]] = []
        side = max(BAND // (plan.n_steps * columns), 1)
        for first in range(0, rows, side):
            if stale():
                return None
            block = (slice(first, min(first + side, rows)), slice(0, columns))
            bands.append(self._band(grid, block, error_estimate))
        cells = {
            name: np.concatenate([band[name] for band in bands]).reshape(grid.shape)
            for name in bands[0]
        }
        y, x = (
            Axis(name, _SCALES[view.ranges[name].scale], plan.axis_values(name))
            for name in (view.y, view.x)
        )
        status, values = cells["status"], cells[view.metric]
        doubt = None
        if error_estimate:
            untrusted = cells[f"{view.metric}_trusted"] == NOT_TRUSTED
            doubt = Doubt(untrusted, x.places, y.places)
        return Map(
            view=view,
            x=x,
            y=y,
            values=values,
            reasons=reasons(values, status, STATUS),
            label=METRICS[view.metric]["meaning"],
            unit=printed(METRICS[view.metric]["unit"]),
            converged=np.isfinite(cells["convergence_time"]),
            doubt=doubt,
            fine=n == FINE,
            variables=cells,
        )

    def _band(self, grid: Grid, block: Any, error_estimate: bool) -> Mapping[str, NDArray[Any]]:
        """The variables of some rows."""
        plan = grid.sweep
        params, model = grid.params(block, self.dtype), grid.model(block)
        dt, n_steps = plan.time.dt, plan.n_steps
        if error_estimate:
            found = sweep(params, model=model, dt=dt, n_steps=n_steps, error_estimate=True)
            return values_of(*found, plan.time.t_end)
        return values_of(sweep(params, model=model, dt=dt, n_steps=n_steps), None, plan.time.t_end)

    def place(self, view: View) -> dict[str, Value] | None:
        """What the selected cell is at."""
        return view.place()

    def scenario(self, place: Mapping[str, Value]) -> Scenario:
        """The scenario of a cell. Raises ViewError."""
        first = next(iter(QUANTITIES))
        grid = Grid(self._plan(place, {first: [place[first]]}))
        return Scenario.of(grid, (slice(0, 1),), self.dtype)

    def cut(self, view: View) -> tuple[str, ...]:
        """A live map has two dimensions: nothing is cut."""
        del view
        return ()

    def sweep_file(self, view: View) -> str:
        """The sweep of a view's fine map, as a file. Raises ViewError."""
        return texts.sweep_file(self.plan(view, FINE))

    def python(self, view: View) -> str:
        """Python that computes a view's fine map. Raises ViewError."""
        return texts.python(self.plan(view, FINE), view)

    def dataset(self, view: View) -> "xr.Dataset":
        """A view's fine map with error estimates, labelled like a store. Raises ViewError."""
        found = self.map(view, FINE, error_estimate=True)
        assert found  # nothing makes it stale
        plan = self.plan(view, FINE).model_copy(update={"error_estimate": True})
        return texts.dataset(Grid(plan), found.variables)


def _axis(view: View, name: str, n: int) -> Any:
    """An axis as a sweep file has it; of `period` the multiples of dt, at most n."""
    if name not in view.ranges:
        raise ViewError(f"the address has the axis `{name}` and must have `range.{name}` too.")
    low, high, scale = (getattr(view.ranges[name], part) for part in ("low", "high", "scale"))
    if name != "period":
        return {scale: [low, high], "n": n}
    dt = float(view.at["dt"])
    if not (dt > 0 and 0 < low < high):
        raise ViewError(f"`period` must be positive, but goes from {low:g} to {high:g}.")
    spaced = np.geomspace(low, high, n) if scale == "log" else np.linspace(low, high, n)
    ticks = np.unique(np.maximum(np.rint(spaced / dt), 1))
    if ticks.size < 2:
        raise ViewError(f"`period` must have two multiples of dt = {dt:g} s in its range.")
    return [float(f"{tick * dt:.12g}") for tick in ticks]
