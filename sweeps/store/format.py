"""What a store has on the disk: its arrays, the flags of a cell, its attributes."""

import hashlib
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from zarr.codecs import BloscCodec, Crc32cCodec

from fic_jax import METRICS, QUANTITIES, TRUST
from sweeps.plan.grid import Grid
from sweeps.plan.shard import RULE
from sweeps.spec.types import STORED, Sweep
from sweeps.store import reduced

# attributes that say which cells and blocks a store has -> what of a command line says it
OF_RUN = {"sweep": "sweep", "error_estimate": "--error-estimate", "block_cells": "--chunk"}

FORMAT = 3  # raise it with a change that older programs can't read
DEFINITION = "motion"  # of the metrics that this program computes
DEFINITIONS = {  # name in a store -> what its metrics are; formats 1 and 2 have no name in them
    "samples": "means over samples at step ends",
    "motion": "integrals and extremes of the motion",
}

NOT_RUN, OK, DIVERGED, FAILED = range(4)
STATUS = {"not run": NOT_RUN, "ok": OK, "diverged": DIVERGED, "failed": FAILED}
UNTRUSTED = 4  # of a statistic of a reduced store; a cell has none of it
# of a cell of a refined grid that was not simulated: it has the values of a cell beside it
OK_NEAR, DIVERGED_NEAR = 5, 6
NEAR = {"ok nearby": OK_NEAR, "diverged nearby": DIVERGED_NEAR}
LEVEL, NO_LEVEL = "level", 255  # of a refined grid: a variable, and its fill value
REFUSED = STATUS | {reduced.NOT_TRUSTED: UNTRUSTED}  # why a statistic has no value, or OK
NO_ESTIMATE, NOT_TRUSTED, TRUSTED = range(3)
TRUSTWORTHY = {"no estimate": NO_ESTIMATE, "not trusted": NOT_TRUSTED, "trusted": TRUSTED}
ERRORS = {f"{name}_error": name for name in STORED}  # error estimate -> its metric
JUDGEMENTS = {f"{name}_trusted": name for name in STORED}  # flag -> the metric that it judges
OLD_JUDGEMENTS = {"trusted": "nmse"}  # formats 1 and 2 judge no other metric
# flag variables; 0 is the fill value
FLAGS = dict.fromkeys((*JUDGEMENTS, *OLD_JUDGEMENTS), TRUSTWORTHY) | {"status": STATUS}
ESTIMATE = (
    "Absolute error of the metric beside it, estimated by running the scenario again with half the "
    "plant step and its switches located inside the step; infinite where only one of the two runs "
    "gives a finite metric, NaN where one left the finite numbers."
)
LEVEL_MEANING = "how often the coarse grid was halved around the cell"
# An attribute of a refined store that its budget ended: the level from which on boxes were left.
BUDGET_LEVEL = "budget_ended_at_level"
AT_END = ("end", BUDGET_LEVEL)  # attributes that a run writes when it has finished
COORDINATE_CHUNK = 1_000_000  # values
# All chunks of an array in one folder: one scan lists them, one fsync keeps their names.
FLAT: Any = {"name": "default", "separator": "."}


def judgements(sweep: Sweep, form: int = FORMAT) -> dict[str, str]:
    """The flags of a store of format `form` that say what is trusted -> the metric of each."""
    if not sweep.error_estimate or sweep.reduce:
        return {}
    return {f"{name}_trusted": name for name in sweep.metrics} if form > 2 else OLD_JUDGEMENTS


def variable_names(sweep: Sweep, form: int = FORMAT) -> list[str]:
    """The variables of a store of format `form`, in the order they are written."""
    if sweep.reduce:
        return [*reduced.variables(sweep, REFUSED), "status"]
    errors = [f"{name}_error" for name in sweep.metrics] if sweep.error_estimate else []
    levels = [LEVEL] if sweep.refine else []
    return [*sweep.metrics, *errors, *judgements(sweep, form), *levels, "status"]


def flags(sweep: Sweep, name: str) -> dict[str, int]:
    """The words of a flag variable and their codes; empty if the variable is none."""
    if sweep.reduce and name != "status":
        return reduced.variables(sweep, REFUSED)[name].flags
    if sweep.refine and name == "status":
        return STATUS | NEAR
    return FLAGS.get(name, {})


def fill_value(sweep: Sweep, name: str) -> float:
    """What a variable has in cells that were not run."""
    if name == LEVEL:
        return NO_LEVEL
    return 0 if flags(sweep, name) else np.nan


def bound(name: str) -> str:
    """The largest error of a trusted metric, as a formula: `max(1 % of nmse, 1e-12)`."""
    scale, floor = {"value": name}.get(TRUST[name].scale, TRUST[name].scale), _floor(name)
    part = f"{100 * TRUST[name].part:g} % of {scale}"
    return f"max({part}, {floor})" if floor else part


def _bound_in_words(name: str) -> str:
    scale, floor = TRUST[name].scale, _floor(name)
    of = {"value": "its value", "T_n": "the reachable torque", "t_end": "the run's time"}[scale]
    part = f"{100 * TRUST[name].part:g} % of {of}"
    return f"{part}, or {floor}" if floor else part


def _floor(name: str) -> str:
    """The smallest bound of a metric with its unit; empty if there is none."""
    unit = METRICS[name]["unit"]
    return f"{TRUST[name].floor:g} {unit}".removesuffix(" 1") if TRUST[name].floor else ""


def arrays(grid: Grid, dtype: str, form: int = FORMAT) -> Iterator[dict[str, Any]]:
    """Arguments of `zarr.create_array` for each array of a store: coordinates, then variables."""
    for dim, length in grid.dims.items():
        for name, values in grid.coordinates(dim, slice(0, 1)).items():
            quantity = QUANTITIES.get(name, {"unit": "1", "meaning": name})
            text = values.dtype.kind == "U"
            yield {
                "name": name,
                "shape": (length,),
                "chunks": (min(COORDINATE_CHUNK, length),),
                "dimension_names": [dim],
                "dtype": np.dtypes.StringDType() if text else values.dtype,
                "compressors": [Crc32cCodec()] if text else _codecs(8),
                "chunk_key_encoding": FLAT,
                "attributes": {"units": quantity["unit"], "long_name": quantity["meaning"]},
            }
    for name in variable_names(grid.sweep, form):
        yield variable(grid, name, dtype)


def variable(grid: Grid, name: str, dtype: str) -> dict[str, Any]:
    """Arguments of `zarr.create_array` for a variable."""
    words = flags(grid.sweep, name)
    if grid.sweep.reduce and name != "status":
        one = reduced.variables(grid.sweep, REFUSED)[name]
        dtype = one.dtype or dtype
        attributes: dict[str, Any] = {"units": one.units, "long_name": one.long_name}
        attributes |= {"ancillary_variables": one.status} if one.status else {}  # CF conventions
    elif words:
        attributes = _flag_meaning(name)
    elif name == LEVEL:
        dtype, attributes = "uint8", {"units": "1", "long_name": LEVEL_MEANING}
    else:
        metric = METRICS[ERRORS.get(name, name)]
        prefix = "estimated error of " if name in ERRORS else ""
        attributes = {"units": metric["unit"], "long_name": prefix + metric["meaning"]}
    if words:
        dtype = "uint8"
        attributes |= {
            "flag_values": list(words.values()),
            "flag_meanings": " ".join(word.replace(" ", "_") for word in words),
        }
    return {
        "name": name,
        "shape": grid.shape,
        "chunks": grid.block_shape,
        "dimension_names": list(grid.dims),
        "dtype": np.dtype(dtype),
        "fill_value": fill_value(grid.sweep, name),
        "compressors": _codecs(np.dtype(dtype).itemsize),
        "chunk_key_encoding": FLAT,
        # An all-NaN chunk is a file too: so a missing file always means "not run".
        "config": {"write_empty_chunks": True},
        "attributes": attributes,
    }


def _flag_meaning(name: str) -> dict[str, Any]:
    if name == "status":
        return {"long_name": "what became of the scenario"}
    if name in OLD_JUDGEMENTS:
        return {"long_name": "whether the estimated error of nmse is at most 1 % of nmse"}
    metric = JUDGEMENTS[name]
    words = f"whether the estimated error of {metric} is at most {_bound_in_words(metric)}"
    return {"long_name": words, "bound": bound(metric)}


def attributes(grid: Grid) -> dict[str, Any]:
    """The attributes of a store that follow from its sweep."""
    sweep = grid.sweep
    record = {
        "format": FORMAT,
        "name": sweep.name,
        "description": sweep.description,
        "sweep": sweep.record(),
        "sweep_sha256": sha256(sweep.record()),
        "block_cells": grid.block_cells,
        # all that does not vary, and which of it the sweep does not name; NetCDF knows no tables
        "held": json.dumps({"dt": sweep.time.dt, "t_end": sweep.time.t_end} | sweep.held()),
        "held_by_default": " ".join(sweep.defaults()),
        "error_estimate": int(sweep.error_estimate),  # NetCDF knows no booleans
        "metrics_definition": DEFINITION,
        "metrics_definition_meaning": DEFINITIONS[DEFINITION],
    }
    record |= {"shard": str(grid.shard), "shard_rule": RULE} if grid.shard else {}
    if sweep.refine:
        record |= {"refined_axes": " ".join(sweep.refined), "refined_levels": sweep.refine.levels}
    record |= {"reduced_over": " ".join(sweep.reduce.gone)} if sweep.reduce else {}
    return record | ({"error_estimate_meaning": ESTIMATE} if sweep.error_estimate else {})


def size(grid: Grid, dtype: str) -> int:
    """Bytes of a finished store before compression: variables and coordinates."""
    if grid.sweep.reduce:
        own = [
            1 if one.flags else np.dtype(one.dtype or dtype).itemsize
            for one in reduced.variables(grid.sweep, REFUSED).values()
        ]
        cell = sum(own) + 1
    else:
        names = variable_names(grid.sweep)
        small = (*FLAGS, LEVEL)
        cell = sum(1 if name in small else np.dtype(dtype).itemsize for name in names)
    coordinates = sum(n * 8 * len(grid.coordinates(d, slice(0, 1))) for d, n in grid.dims.items())
    return grid.own_cells * cell + coordinates


def sha256(record: str) -> str:
    """The hash of a sweep record: of its text, so that fields of later versions change nothing."""
    return hashlib.sha256(record.encode()).hexdigest()


def _codecs(itemsize: int) -> list[Any]:
    """Compression and a CRC: Blosc alone reads most flipped bits as wrong numbers."""
    # lz4: as small as zstd's first level, on metrics, in half the time
    return [BloscCodec(cname="lz4", clevel=9, shuffle="shuffle", typesize=itemsize), Crc32cCodec()]
