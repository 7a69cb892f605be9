"""The findings beyond the paper's claims: what each reads, measures and tells."""

from collections.abc import Callable
from dataclasses import dataclass

import xarray as xr

from sweeps.paper import (
    limit_cycle,
    online_gains,
    readings,
    saturation,
    search_resolution,
    variable_step,
)
from sweeps.paper.record import Section


@dataclass(frozen=True)
class Finding:
    """A study: its data is small, and all that its section and its figure need."""

    name: str  # of its data and its figure
    stores: tuple[str, ...]  # sweeps of the library that it reads
    measure: Callable[..., xr.Dataset]  # from those stores
    section: Callable[[xr.Dataset], Section]


FINDINGS = (
    Finding("readings", (), readings.measure, readings.section),
    Finding("variable_step", ("period-map",), variable_step.measure, variable_step.section),
    Finding("saturation", ("atlas-saturated",), saturation.measure, saturation.section),
    Finding(
        "search_resolution",
        ("search-resolution",),
        search_resolution.measure,
        search_resolution.section,
    ),
    Finding("limit_cycle", (), limit_cycle.measure, limit_cycle.section),
    Finding("online_gains", (), online_gains.measure, online_gains.section),
)
