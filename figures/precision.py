"""Single against double precision over the same sweep: where float32 is enough."""

import argparse
import itertools
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures.heatmap import panels
from figures.planes import select
from figures.style import save
from sweeps.store.format import DIVERGED, OK
from sweeps.store.opening import dataset

BOUNDS = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # relative differences of the table
SHARES = {"half of the scenarios below": 0.5, "95 % of the scenarios below": 0.95}


def difference(single: xr.Dataset, double: xr.Dataset, metric: str = "nmse") -> xr.DataArray:
    """|single - double| / |double| of a metric; NaN where a run diverged in either."""
    regular = (single["status"] == OK) & (double["status"] == OK)
    one, other = single[metric].astype(float), double[metric]
    return (abs(one - other) / abs(other).clip(min=np.finfo(float).tiny)).where(regular)


def plane(apart: xr.DataArray, x: str, y: str, share: float) -> xr.Dataset:
    """What a share of the scenarios differs by at most, over all dimensions but two."""
    rest = [dim for dim in apart.dims if dim not in (x, y)]
    drawn = apart.quantile(share, rest, skipna=True).drop_vars("quantile")
    drawn.attrs = {"units": "1", "long_name": "relative difference of nmse"}
    status = xr.where(drawn.notnull(), OK, DIVERGED).astype("uint8")
    named = {"name": "float32 against float64"}
    return xr.Dataset({"difference": drawn, "status": status}, attrs=named)


def plot(apart: xr.DataArray, x: str = "Kenv", y: str = "K0") -> Figure:
    """Two maps over x and y: what half and what 95 % of the scenarios stay below."""
    planes = {title: plane(apart, x, y, share) for title, share in SHARES.items()}
    cut = {title: select(data, x=x, y=y, metric="difference") for title, data in planes.items()}
    return panels(list(cut.items()))


def table(apart: xr.DataArray) -> str:
    """The share of scenarios beyond each bound, in all and for each decade of K0."""
    parts = {"all": apart}
    for low, high in itertools.pairwise((1.0, 10.0, 100.0, 1000.0)):
        inside = (apart["K0"] >= low) & (apart["K0"] <= high)
        parts[f"K0 {low:g} to {high:g}"] = apart.sel(K0=inside)
    lines = [f"| beyond | {' | '.join(parts)} |", "|---" * (len(parts) + 1) + "|"]
    for bound in BOUNDS:
        shares = [100 * float((part > bound).sum() / part.count()) for part in parts.values()]
        lines.append(f"| {bound:g} | {' | '.join(f'{share:.3g} %' for share in shares)} |")
    medians = [f"{float(part.median()):.1e}" for part in parts.values()]
    return "\n".join([*lines, f"| median | {' | '.join(medians)} |"]) + "\n"


def main() -> None:
    """Compare two stores of one sweep; writes a picture and, beside it, a table."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("single", type=Path)
    parser.add_argument("double", type=Path)
    parser.add_argument("picture", type=Path)
    asked = parser.parse_args()
    apart = difference(dataset(asked.single), dataset(asked.double)).compute()
    save(plot(apart), asked.picture)
    asked.picture.with_suffix(".md").write_text(table(apart), encoding="utf-8")


if __name__ == "__main__":
    main()
