"""One sweep in single and in double precision: where float32 is enough."""

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
    """|single - double| / |double| of a metric; NaN where either run diverged."""
    regular = (single["status"] == OK) & (double["status"] == OK)
    one, other = single[metric].astype(float), double[metric]
    return (abs(one - other) / abs(other).clip(min=np.finfo(float).tiny)).where(regular)


def quantile(apart: xr.DataArray, x: str, y: str, share: float) -> xr.Dataset:
    """Over x and y: the difference that a share of the other dimensions stays below."""
    rest = [dim for dim in apart.dims if dim not in (x, y)]
    drawn = apart.quantile(share, rest, skipna=True).drop_vars("quantile")
    drawn.attrs = {"units": "1", "long_name": "relative difference of nmse"}
    status = xr.where(drawn.notnull(), OK, DIVERGED).astype("uint8")
    named = {"name": "float32 against float64"}
    return xr.Dataset({"difference": drawn, "status": status}, attrs=named)


def plot(apart: xr.DataArray, x: str = "Kenv", y: str = "K0") -> Figure:
    """Two maps over x and y: the difference that half and that 95 % of the scenarios stay below."""
    maps = [(title, quantile(apart, x, y, share)) for title, share in SHARES.items()]
    return panels([(t, select(data, x=x, y=y, metric="difference")) for t, data in maps])


def table(apart: xr.DataArray) -> str:
    """Markdown: the share of scenarios beyond each bound, of all and of each decade of K0."""
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
    """Compare two stores of one sweep; write a picture and, beside it, a table."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("single", type=Path)
    parser.add_argument("double", type=Path)
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args()
    apart = difference(dataset(arguments.single), dataset(arguments.double)).compute()
    save(plot(apart), arguments.picture)
    arguments.picture.with_suffix(".md").write_text(table(apart), encoding="utf-8")


if __name__ == "__main__":
    main()
