"""What a reduced store says of the dimensions that it does not have."""

import json
from collections.abc import Iterator

import xarray as xr

from fic_jax import QUANTITIES
from figures import style
from sweeps.spec.digits import digits
from sweeps.spec.types import Reduction, Sweep
from sweeps.store.format import REFUSED
from sweeps.store.reduced import variables


def reduced(data: xr.Dataset) -> tuple[Sweep, Reduction] | None:
    """The sweep of a reduced store, and its reduction; None of any other store."""
    record = json.loads(data.attrs.get("sweep", "{}"))
    if "reduce" not in record:
        return None
    sweep = Sweep.model_validate(record)
    return (sweep, sweep.reduce) if sweep.reduce else None


def over(data: xr.Dataset) -> Iterator[str]:
    """What each value is over, or at the best of: a text for each dimension that is gone."""
    if found := reduced(data):
        sweep, reduce = found
        yield from (f"over {_values(sweep, dim)}" for dim in reduce.over)
        if reduce.best:
            yield f"at the best of {_values(sweep, reduce.best)}"


def _values(sweep: Sweep, dim: str) -> str:
    """What varies along a dimension: how many values, and their range."""
    n = sweep.dims[dim]
    if dim in sweep.model:
        return _listed([style.words(choice) for choice in sweep.model[dim]])
    if dim == "case":
        return f"{n:,} cases of {_listed([_range(sweep, name) for name in sweep.cases])}"
    if dim == "scenario" and sweep.sample:
        ranges = [_range(sweep, name) for name in sweep.sample.ranges]
        return f"{n:,} drawn scenarios of {_listed(ranges)}"
    return f"{n:,} values of {_range(sweep, dim)}"


def _listed(texts: list[str]) -> str:
    """Texts as a sentence lists them: `a, b and c`."""
    return " and ".join(filter(None, (", ".join(texts[:-1]), texts[-1])))


def _range(sweep: Sweep, name: str) -> str:
    """A field, its least and its largest value, its unit."""
    ends = sweep.outermost(name)
    low, high = (style.number(end, digits(ends)) for end in (ends.min(), ends.max()))
    said = f"{low} to {high}" if low != high else low
    return f"{style.SYMBOLS[name]} = {said} {style.units_text(QUANTITIES[name]['unit'])}".strip()


def why_gone(data: xr.Dataset, name: str, there: str) -> str:
    """What to say of a dimension or field that a store had before it was reduced; else empty."""
    if not (found := reduced(data)):
        return ""
    sweep, reduce = found
    fields = {"case": sweep.cases, "scenario": sweep.sample.ranges if sweep.sample else ()}
    for dim in reduce.gone:
        if name == dim or name in fields.get(dim, ()):
            how = "was reduced over: each cell is of all its values"
            if dim == reduce.best:
                how = f"was reduced to its best value, which 'best_{name}' says"
            return f"'{name}' {how}. There are: {there}."
    return ""


def spacing(data: xr.Dataset, metric: str) -> str:
    """The spacing of the axis of which a variable has values, "log" or "linear".

    Empty if it has other values.
    """
    if not (found := reduced(data)):
        return ""
    sweep, _ = found
    one = variables(sweep, REFUSED).get(metric)
    if one is None or not one.place:
        return ""
    ranges = sweep.sample.ranges if sweep.sample else {}
    axis = sweep.axes.get(one.place, ranges.get(one.place))
    if axis is None or isinstance(axis, list):  # a list, a column of cases, a number of a case
        column = axis or sweep.cases.get(one.place, [0.0])
        return "log" if min(column) > 0 and max(column) > 10**1.5 * min(column) else "linear"
    return "log" if axis.log else "linear"
