"""What is copied and saved of a map: a sweep file, Python, a dataset for a picture."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from fic_jax import QUANTITIES, Model, Params
from sweeps.explore.view import View
from sweeps.maps import SIGNED_METRICS
from sweeps.plan.grid import Grid
from sweeps.spec.mistakes import command
from sweeps.spec.types import SpacedRange, Sweep
from sweeps.store import format as store_format

if TYPE_CHECKING:
    import xarray as xr

STARTS = f"# {command('run', 'explored.toml')} computes it\n"


def sweep_file(sweep: Sweep) -> str:
    """A sweep as the text of a file that gives the same numbers."""
    record = json.loads(sweep.model_dump_json(exclude_defaults=True))
    default = vars(Params()) | vars(Model())
    record["time"] = {"dt": sweep.time.dt, "t_end": sweep.time.t_end}
    for table in ("model", "constants"):
        held = record.pop(table, {})
        record[table] = {n: value for n, value in held.items() if default[n] != value}
    tables = {name: value for name, value in record.items() if isinstance(value, dict)}
    lines = [f"{name} = {_toml(value)}" for name, value in record.items() if name not in tables]
    for name in ("time", "model", "constants", "axes", "cases", "sample", "reduce", "refine"):
        if tables.get(name):
            lines += ["", f"[{name}]"]
            lines += [f"{key} = {_toml(value)}" for key, value in tables[name].items()]
    return STARTS + "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    """A value in TOML: numbers, texts and lists are those of JSON."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value)


def python(sweep: Sweep, view: View) -> str:
    """Python that computes the metric of a map without the explorer."""
    (y, _), (x, _) = sweep.axes.items()
    default = vars(Params()) | vars(Model())
    fields = [f"{n}={v!r}" for n, v in sweep.constants.items() if default[n] != v]
    choices = [f"{n}={v!r}" for n, v in sweep.model.items() if default[n] != v]
    lines = [
        "import numpy as np",
        *(["import jax", 'jax.config.update("jax_enable_x64", True)'] if sweep.bits == 64 else []),
        "from fic_jax import Model, Params, sweep",
        "from sweeps.spec.types import SpacedRange",
        "",
        *(f"{name} = {_values(axis)}" for name, axis in sweep.axes.items()),
        f"{y}_, {x}_ = np.meshgrid({y}, {x}, indexing='ij')",
        f"params = Params({', '.join([f'{y}={y}_.ravel()', f'{x}={x}_.ravel()', *fields])})",
        f"metrics = sweep(params, model=Model({', '.join(choices)}), dt={sweep.time.dt!r}, "
        f"n_steps={sweep.n_steps})",
        f"{view.metric} = metrics.{view.metric}.reshape({y}.size, {x}.size)  # [{y}, {x}]",
    ]
    return "\n".join(lines) + "\n"


def _values(axis: Any) -> str:
    if not isinstance(axis, SpacedRange):
        return f"np.array({list(axis)!r})"
    scale = "log" if axis.log else "lin"
    return f"SpacedRange({scale}={axis.ends!r}, n={axis.n}).values()"


def dataset(grid: Grid, variables: Mapping[str, NDArray[Any]]) -> "xr.Dataset":
    """Variables of all cells of a grid, labelled like a store."""
    import xarray as xr

    data = xr.Dataset(attrs=store_format.attributes(grid))
    for dim in grid.dims:
        for name, values in grid.coordinates(dim).items():
            about = QUANTITIES.get(name, {"unit": "1", "meaning": name})
            attributes = {"units": about["unit"], "long_name": about["meaning"]}
            data = data.assign_coords({name: (dim, values, attributes)})
    for name in store_format.variable_names(grid.sweep):
        attributes = store_format.variable(grid, name, "float32")["attributes"]
        data[name] = (tuple(grid.dims), variables[name], attributes)
    return data


def python_of_store(path: Path, view: View, at: Mapping[str, int], level: float) -> str:
    """Python that reads the cells of a map from a store; `at` has the index of each cut."""
    cut = ", ".join(f"{dim}={index}" for dim, index in at.items())
    notes = ", ".join(f"{dim} = {view.at[dim]}" for dim in at)
    over = repr(list(view.over))
    end = {
        "worst": f".max({over}, skipna=False)",
        "mean": f'.mean({over}, skipna=False, dtype="float64")',
        "median": f'.quantile(0.5, {over}, method="inverted_cdf", skipna=False)',
        "share": f" <= {level!r}).mean({over})",
    }[view.how]
    cells = f'data["{view.metric}"]' + (f".isel({cut})" if cut else "")
    signed = view.how == "worst" and view.metric in SIGNED_METRICS
    if view.over and not signed:
        cells = (f"({cells}" if view.how == "share" else cells) + end
    farthest = f"{view.metric} = {view.metric}.isel(abs({view.metric}).argmax({over}))"
    lines = [
        "import xarray as xr",
        "",
        f"data = xr.open_zarr({str(path)!r}, chunks=None)",
        f"{view.metric} = {cells}" + (f"  # {notes}" if notes else ""),
        *([farthest] if view.over and signed else []),
        f'{view.metric} = {view.metric}.transpose("{view.y}", "{view.x}")',
    ]
    return "\n".join(lines) + "\n"
