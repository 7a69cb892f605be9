"""The page of the gallery: for each figure its picture, two sentences, caption and command."""

import json
from collections.abc import Iterator, Sequence

import xarray as xr

from fic_jax import QUANTITIES
from figures import reduction

HEAD = """# Gallery

Maps far beyond the paper's grid. `make atlas` runs the sweeps and draws the figures as PNG and SVG
into results/atlas. It resumes a sweep that was interrupted and skips one that is complete.
`make gallery` also writes this page: its numbers are computed from the stores.

A hatch over a colour marks a number that is not trusted ([which cells to trust](accuracy.md)).
A cell without a number has no colour, and the legend says why. Panels that are compared share
their scale. The sweep files are in sweeps/library.
"""


def page(entries: Sequence[str]) -> str:
    """The whole page in Markdown."""
    return "\n".join([HEAD, *entries])


def entry(name: str, title: str, alt: str, finding: str, data: Sequence[xr.Dataset]) -> str:
    """One figure on the page."""
    runs = [
        f"fic-sweep run {one.attrs['name']} --out results/atlas/{one.attrs['name']}.zarr"
        for one in data
    ]
    commands = "\n".join([*runs, f"python -m figures.atlas --only {name}"])
    caption = " ".join([f"{alt}.", *(constants(one) for one in data)])
    return (
        f"## {title}\n\n![{alt}](gallery/{name}.png)\n\n{finding}\n\n"
        f"*{caption}*\n\n```sh\n{commands}\n```\n"
    )


def constants(data: xr.Dataset) -> str:
    """What a sweep varies, and all that it holds constant, in one sentence each."""
    axes = ", ".join(f"{n} {dim}" for dim, n in data.sizes.items())
    sweep, reduce = reduction.reduced(data) or (None, None)
    gone = [f"{sweep.dims[dim]} {dim}" for dim in reduce.gone] if sweep and reduce else []
    reduced = f", each over {', '.join(gone)}" if gone else ""
    held = ", ".join(_held(json.loads(data.attrs["held"])))
    name = data.attrs["name"]
    return f"Sweep {name}: {axes}{reduced}. Constant: {held}."


def _held(held: dict[str, float | str]) -> Iterator[str]:
    for name, value in held.items():
        if isinstance(value, str):
            yield f"{name} {value}"
        else:
            unit = "s" if name in ("dt", "t_end") else QUANTITIES[name]["unit"]
            yield f"{name} = {value:.8g} {unit.replace('*', '·')}".removesuffix(" 1")
