"""Numbers of a finding: values that are trusted, shares in percent."""

import numpy as np
import xarray as xr

from sweeps.store.format import OK, TRUSTED


def trusted_values(data: xr.Dataset, metric: str) -> xr.DataArray:
    """A metric; NaN where it is not trusted or the run diverged."""
    good = (data["status"] == OK) & (data[f"{metric}_trusted"] == TRUSTED)
    return data[metric].where(good)


def converged(data: xr.Dataset) -> xr.DataArray:
    """Whether the torque converges, and this is trusted."""
    return abs(trusted_values(data, "convergence_time")) < np.inf


def percent(share: float) -> str:
    """A part as a whole number of percent."""
    return f"{100 * share:.0f} %"
