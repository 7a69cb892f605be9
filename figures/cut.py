"""A part of a store for a picture: some dimensions drawn, the others fixed; what each cell is."""

import difflib
import json
import math
from collections.abc import Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fic_jax import QUANTITIES
from figures import reduction, style
from sweeps import maps
from sweeps.maps import edges_of
from sweeps.spec.digits import LEAST, digits
from sweeps.store.format import (
    DIVERGED,
    DIVERGED_NEAR,
    ERRORS,
    FLAGS,
    JUDGEMENTS,
    LEVEL,
    NO_LEVEL,
    OK,
    OK_NEAR,
    OLD_JUDGEMENTS,
    REFUSED,
    TRUSTED,
)
from sweeps.store.reduced import NONE

# Part of the scenarios of a statistic; beyond it the statistic is drawn as not trusted.
FEW_DOUBTED = 0.01
MOST_COMPARED = 100_000  # values of a dimension; the digits of more are not compared
Wanted = Mapping[str, float | str]  # dimension -> the value at which it is fixed


class PlotError(ValueError):
    """The data cannot give the requested figure; the text is one clear line."""


@dataclass(frozen=True)
class Cells:
    """A metric in the cells of a picture, what became of the others, and what is held constant."""

    metric: str
    label: str
    values: np.ma.MaskedArray[Any, Any]
    special: Mapping[str, NDArray[np.bool_]]  # reason, a key of style.HATCHES -> cells
    untrusted: NDArray[np.bool_] | None  # cells that ran but are not trusted; None: unknown
    simulated: NDArray[np.bool_] | None  # the others have a value from beside; None: not refined
    level: NDArray[np.int_] | None  # how often the grid was halved around the cell
    trust_bound: str  # when a cell is not trusted, in words
    name: str  # what the sweep is, in words
    fixed: tuple[str, ...]  # "symbol = value unit" of each fixed dimension, and the contact
    held: tuple[str, ...]  # the same of all that the sweep holds constant
    cut: Mapping[str, str]  # fixed dimension -> its value, in digits that tell it from the others
    spacing: str  # of the axis whose values these are, "log" or "linear"; empty of others
    choices: tuple[str, ...]  # words of the values 1, 2, ...; empty if they are numbers


def cut(data: xr.Dataset, drawn: Collection[str], metric: str, at: Wanted) -> xr.Dataset:
    """A metric, its flags and the coordinates, in memory: `drawn` dimensions, the others fixed.

    `at` fixes dimensions, each at the value nearest to the wanted one. A dimension that nobody
    names is fixed at its middle. Raises PlotError for a request that the store can't answer.
    """
    for name in at:
        if name in data.coords and data[name].dims not in ((name,), ()):
            raise PlotError(f"'{name}' varies along '{data[name].dims[0]}', which `at` can fix.")
        require_dimension(name, data, metric)
        if name in drawn:
            raise PlotError(f"'{name}' is drawn as an axis; `at` cannot fix it too.")
    index = {
        str(dim): _position(data[dim], at[str(dim)]) if dim in at else data.sizes[dim] // 2
        for dim in data[metric].dims
        if dim not in drawn
    }
    own = _own_status(data, metric)
    names = (metric, _judgement(data, metric), own, _doubted(own), LEVEL, "status")
    wanted = [name for name in names if name in data]
    # isel before load: a store may be larger than memory, a picture is not
    part = data[wanted].isel(index).load()
    n = {str(c.name): _digits(data[c.name]) for c in _fixed(part) if c.dtype.kind == "f"}
    values = {dim: part[dim].item() if dim in part.coords else i for dim, i in index.items()}
    texts = {dim: f"{v:.{n[dim]}g}" if dim in n else str(v) for dim, v in values.items()}
    return part.assign_attrs(digits=n, cut=texts, index=tuple(index.values()))


def _fixed(part: xr.Dataset) -> list[xr.DataArray]:
    return [coordinate for coordinate in part.coords.values() if coordinate.ndim == 0]


def _digits(coordinate: xr.DataArray) -> int:
    return digits(coordinate.values) if coordinate.size <= MOST_COMPARED else LEAST


def cells(part: xr.Dataset, metric: str) -> Cells:
    """What `cut` has found, cell by cell."""
    array = part[metric]
    values = array.values.astype(float)
    choices = _choices(array)
    if choices:
        values = np.where(values > 0, values, np.nan)
    # xarray decodes status 0, the fill value, as NaN
    status = np.nan_to_num(part["status"].values) if "status" in part else np.ones(values.shape)
    simulated = np.isin(status, (OK, DIVERGED))  # of a refined store: not the cells beside
    for code, meant in ((OK_NEAR, OK), (DIVERGED_NEAR, DIVERGED)):
        status = np.where(status == code, meant, status)
    if own := _own_status(part, metric):
        status = np.where(status == OK, np.nan_to_num(part[own].values), status)
    special = {key: status == code for key, code in REFUSED.items() if code != OK}
    good = status == OK
    special["infinite"] = good & np.isinf(values)
    judgement, doubted = _judgement(part, metric), _doubted(own)
    untrusted, bound = None, ""
    if judgement:
        untrusted = good & (part[judgement].values != TRUSTED)
        bound = f"error > {_bound(part, judgement)}"
    elif doubted in part:
        untrusted = good & (part[doubted].values > FEW_DOUBTED)
        bound = f"more than {100 * FEW_DOUBTED:g} % of the scenarios"
    hidden = ~good | ~np.isfinite(values)
    special["no value"] = hidden & ~np.logical_or.reduce(list(special.values()))
    contact, held = _held(part)
    n = part.attrs["digits"]
    return Cells(
        metric=metric,
        label=with_units(str(array.attrs.get("long_name", metric)), array),
        values=np.ma.masked_array(values, mask=hidden),
        special={key: cells for key, cells in special.items() if cells.any()},
        untrusted=untrusted,
        simulated=simulated if LEVEL in part else None,
        level=_levels(part[LEVEL].values) if LEVEL in part else None,
        trust_bound=bound,
        name=str(part.attrs.get("description") or part.attrs.get("name", "")),
        fixed=(*contact, *(_equation(c, n.get(c.name)) for c in _fixed(part))),
        held=held,
        cut=part.attrs["cut"],
        spacing=reduction.spacing(part, metric),
        choices=tuple(style.words(choice) for choice in choices),
    )


def _levels(values: NDArray[Any]) -> NDArray[np.int_]:
    """Levels as whole numbers; xarray decodes those that are not known as NaN."""
    return np.asarray(np.nan_to_num(values, nan=NO_LEVEL), dtype=int)


def require_metric(metric: str, data: xr.Dataset) -> None:
    """Raise PlotError unless the store has a metric, or an error estimate, of that name."""
    judgements = JUDGEMENTS | OLD_JUDGEMENTS
    if metric in (*ERRORS, *judgements) and not any(name in data for name in judgements):
        raise PlotError(
            f"There is no '{metric}': the store has no error estimates; "
            "run its sweep with --error-estimate."
        )
    if metric in judgements:
        judged = judgements[metric]
        raise PlotError(
            f"'{metric}' is no metric: a picture of '{judged}' marks what is not trusted."
        )
    states = [n for n, v in data.data_vars.items() if n in FLAGS or _is_state(v)]
    if metric in states:
        hatched = "a picture of a metric hatches what has no value"
        raise PlotError(f"'{metric}' is no metric: {hatched}.")
    _require(metric, [n for n in data.data_vars if n not in states], "metric")


def require_dimension(name: str, data: xr.Dataset, metric: str) -> None:
    """Raise PlotError unless a metric has a dimension of that name."""
    dims = [str(dim) for dim in data[metric].dims]
    if gone := reduction.why_gone(data, name, ", ".join(dims)):
        raise PlotError(gone)
    held = json.loads(data.attrs.get("held", "{}"))
    if name in held and name not in dims:
        value = held[name]
        if name in QUANTITIES:
            value = f"{value:.8g} {QUANTITIES[name]['unit']}".removesuffix(" 1")
        there = ", ".join(dims)
        raise PlotError(f"'{name}' does not vary here: it is {value}. There are: {there}.")
    _require(name, dims, "dimension")


def _require(name: str, known: Iterable[Hashable], what: str) -> None:
    names = [str(item) for item in known]
    if name in names:
        return
    lower = {item.lower(): item for item in names}
    near = difflib.get_close_matches(str(name).lower(), lower, n=1)
    hint = f" Did you mean '{lower[near[0]]}'?" if near else ""
    raise PlotError(f"There is no {what} '{name}'.{hint} There are: {', '.join(names)}.")


def _judgement(data: xr.Dataset, metric: str) -> str:
    """The flag that judges a metric, or the metric of an error; empty if the store has none."""
    judged = ERRORS.get(metric, metric)
    names = (name for name, of in (JUDGEMENTS | OLD_JUDGEMENTS).items() if of == judged)
    return next((name for name in names if name in data), "")


def _choices(array: xr.DataArray) -> list[str]:
    """The choices of the model that a variable of a reduced store has; empty if it has numbers."""
    none, *choices = str(array.attrs.get("flag_meanings", "")).split() or [""]
    return choices if none == NONE else []


def _is_state(array: xr.DataArray) -> bool:
    """Whether a variable says what became of cells."""
    return "flag_values" in array.attrs and not _choices(array)


def _own_status(data: xr.Dataset, metric: str) -> str:
    """The flag that says what became of a statistic of a reduced store; empty if it has none."""
    return str(data[metric].attrs.get("ancillary_variables", ""))


def _doubted(status: str) -> str:
    """The variable with the part of a statistic's scenarios that is not trusted, by its flag."""
    return f"{status.removesuffix('_status')}_untrusted_share" if status else ""


def _bound(data: xr.Dataset, judgement: str) -> str:
    """The bound of a judgement, as the store has it."""
    if judgement in OLD_JUDGEMENTS:
        return f"{100 * float(data.attrs.get('trust_bound', 0.01)):g} % of nmse"
    return str(data[judgement].attrs.get("bound", "its bound"))


def _position(coordinate: xr.DataArray, wanted: float | str) -> int:
    """Index of the value nearest to `wanted`, on the scale of the axis."""
    name, values = str(coordinate.name), coordinate.values
    if values.dtype.kind not in "iuf":
        _require(str(wanted), values, f"value of {name}")
        return [str(value) for value in values].index(str(wanted))
    try:
        number = float(wanted)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise PlotError(f"{name} is numeric, but `at` names '{wanted}'.")
    n = digits([*values, number]) if values.size <= MOST_COMPARED else 8
    if len(values) == 1 and not math.isclose(number, values[0], rel_tol=1e-6, abs_tol=1e-12):
        only = f"{values[0]:.{n}g}"
        raise PlotError(f"{name} = {number:.{n}g} was not run; its only value is {only}.")
    grid, scale = values.astype(float), scale_of(coordinate)
    edges = edges_of(np.sort(grid), scale if scale == "log" else "linear")
    # a case, a scenario: there is none between two
    whole = scale == "category" and values.dtype.kind in "iu" and number not in values
    if (len(values) > 1 and not edges[0] <= number <= edges[-1]) or whole:
        span = f"{grid.min():.{n}g} to {grid.max():.{n}g} {style.units_text(units(coordinate))}"
        where = "is no index of" if whole else "lies outside"
        raise PlotError(f"{name} = {number:.{n}g} {where} the sweep, which covers {span.strip()}.")
    ratio = np.log(grid) - math.log(number) if scale == "log" else grid - number
    return int(np.argmin(np.abs(ratio)))


def _held(data: xr.Dataset) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The contact of the whole sweep, and all else that it holds constant, the defaults last."""
    held = json.loads(data.attrs.get("held", "{}"))
    defaults = data.attrs.get("held_by_default", "").split()
    times = [f"{name} = {held[name]:.8g} s" for name in ("dt", "t_end") if name in held]
    choices = {name: choice for name, choice in held.items() if isinstance(choice, str)}
    numbers = {name: value for name, value in held.items() if name in QUANTITIES}
    given = [
        f"{name}: {style.words(choice)}"
        for name, choice in choices.items()
        if name not in ("contact", *defaults)
    ]
    given += [_constant(name, value) for name, value in numbers.items() if name not in defaults]
    default = {name: value for name, value in numbers.items() if name in defaults}
    rest = [_constant(name, value) for name, value in default.items() if value]
    zero = ", ".join(style.SYMBOLS[name] for name, value in default.items() if not value)
    rest += [f"{zero} = 0"] if zero else []
    rest[:1] = [f"by default {text}" for text in rest[:1]]
    contact = (style.words(choices["contact"]),) if "contact" in choices else ()
    return contact, (*given, *times, *rest, *reduction.over(data))


def _constant(name: str, value: float) -> str:
    unit = style.units_text(QUANTITIES[name]["unit"])
    return f"{style.SYMBOLS[name]} = {style.number(value, digits([value]))} {unit}".strip()


def _equation(coordinate: xr.DataArray, n: int | None) -> str:
    """`symbol = value unit` of a fixed coordinate with n digits; a choice of the model in words."""
    value = coordinate.item()
    if coordinate.dtype.kind in "OUT":
        text = style.words(str(value))
        return text if coordinate.name == "contact" else f"{symbol(coordinate)}: {text}"
    text = style.number(value, n) if n else str(value)
    return f"{symbol(coordinate)} = {text} {style.units_text(units(coordinate))}".strip()


def units(array: xr.DataArray) -> str:
    """The unit of a variable, as the store has it."""
    return str(array.attrs.get("units", ""))


def with_units(text: str, array: xr.DataArray) -> str:
    """A text with the unit of a variable in brackets."""
    unit = style.units_text(units(array))
    return f"{text} ({unit})" if unit else text


def symbol(coordinate: xr.DataArray) -> str:
    """The symbol of a coordinate, or its name."""
    return style.SYMBOLS.get(str(coordinate.name), str(coordinate.name).replace("_", " "))


def scale_of(coordinate: xr.DataArray) -> str:
    """The scale on which a dimension is drawn (`sweeps.maps.scale_of`)."""
    return maps.scale_of(coordinate.values, str(coordinate.name))
