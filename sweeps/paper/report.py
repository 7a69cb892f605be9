"""The whole report: stores, verdicts, findings, pictures, pages."""

import os
import platform
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import xarray as xr

from sweeps import LIBRARY, runner
from sweeps.paper.claims import CLAIMS
from sweeps.paper.findings import FINDINGS, name_of
from sweeps.paper.judge import Claim, judge
from sweeps.paper.pages import (
    Section,
    claim_section,
    finding_section,
    markdown,
    page_html,
    verdict_of,
)
from sweeps.paper.scenarios import LOCATED
from sweeps.provenance import provenance
from sweeps.runner import Progress
from sweeps.spec.mistakes import SweepError, command
from sweeps.spec.reading import load
from sweeps.store.opening import Store, dataset, open_store

# The printed reading with located switches; its claims are also tried at shorter periods, of which
# the paper names none.
READING = replace(LOCATED, others=(0.001, 0.002, 0.005))
PICTURES = "figures"  # folder of the pictures, beside the pages
PRECISION = 32  # bits of a store that is run here, as of `fic-sweep run`

Say = Callable[[str], None]  # gets a line of progress; may raise KeyboardInterrupt
Draw = Callable[[Path, Mapping[str, xr.Dataset]], Iterable[str]]  # pictures; yields their stems


def make(
    results: Path,
    say: Say,
    running: Callable[[str, Progress], None],
    draw: Draw,
    *,
    claims: Iterable[Claim] = CLAIMS,
    findings: Sequence[ModuleType] = FINDINGS,
    docs: Path | None = None,
) -> list[Path]:
    """Make everything under `results`; returns the pages, report.md and report.html.

    A folder `docs` gets the Markdown page and its pictures once more. Raises SweepError where a
    folder or a store can't be used.
    """
    for folder in (results, results / PICTURES, *([docs / "report"] if docs else [])):
        writable(folder)
    names = dict.fromkeys(name for finding in findings for name in finding.STORES)
    paths = stores(results, names, running)
    judged = sections(claims, say)
    data, found = {}, []
    for finding in findings:
        name = name_of(finding)
        data[name] = finding.measure(*(dataset(paths[store]) for store in finding.STORES))
        found.append(finding_section(finding, data[name]))
        say(f"measured {name.replace('_', ' ')}")
    folder, pictures = results / PICTURES, []
    for stem in draw(folder, data):
        pictures.append(stem)
        say(f"drew {folder / stem}.png")
    page = partial(markdown, judged, found, origin(paths), pictures)
    pages = [results / "report.md", results / "report.html"]
    write(pages[0], page(PICTURES))
    write(pages[1], page_html(page(PICTURES), results))
    if docs:
        for stem in {section.figure for section in (*judged, *found)}.intersection(pictures):
            shutil.copyfile(folder / f"{stem}.png", docs / "report" / f"{stem}.png")
        pages.append(docs / "report.md")
        write(pages[2], page("report"))
    return pages


def sections(claims: Iterable[Claim], say: Say) -> list[Section]:
    """The section of each claim; `say` gets each verdict at once."""
    found = []
    for claim in claims:
        judgement = judge(claim, READING)
        found.append(claim_section(judgement))
        say(f"{claim.id:4}{re.sub('[*`]', '', verdict_of(judgement))}")
    return found


def stores(
    folder: Path,
    names: Iterable[str],
    tell: Callable[[str, Progress], None],
    library: Path = LIBRARY,
) -> dict[str, Path]:
    """Finished stores of library sweeps under `folder`: name -> path.

    Runs what is missing and resumes what is unfinished. Raises SweepError for a store that another
    program or another sweep made.
    """
    paths = {name: folder / f"{name}.zarr" for name in names}
    # existing stores first: a mistake shows before anything runs
    opened = {name: _reopened(path, library, name) for name, path in paths.items() if path.exists()}
    for name, path in paths.items():
        store = opened.get(name) or runner.start(
            path, load(library / f"{name}.toml"), None, PRECISION
        )
        runner.run(store, partial(tell, name))
    return paths


def _reopened(path: Path, library: Path, name: str) -> Store:
    """An existing store, to be used or continued in its own precision."""
    store = open_store(path)
    if store.grid.sweep.record() != load(library / f"{name}.toml").record():
        raise SweepError(
            f"{path}: holds another sweep than `{name}` of the library; remove it and "
            f"{command('report', '--results', path.parent)} runs the sweep again, or name another "
            "folder with --results"
        )
    try:
        return runner.reopen(path, int(store.dtype.removeprefix("float")))
    except SweepError as error:
        raise SweepError(f"{error}; or remove it, and the report runs it again") from None


def origin(paths: Mapping[str, Path]) -> dict[str, str]:
    """Which program made the report, of what, when and where."""
    program = provenance(64)
    packages = ("jax", "jaxlib", "numpy", "scipy", "xarray", "zarr", "matplotlib")
    made = {name: dataset(path).attrs for name, path in paths.items()}
    return {
        "program": f"fic_jax {program['fic_jax']}, revision `{program['revision']}`",
        "arithmetic": f"numerics {program['numerics']}, {program['arithmetic']}",
        "packages": ", ".join(f"{name} {version(name)}" for name in packages),
        "claims": "double precision (float64)",
        "stores": ", ".join(
            f"{name} ({a['dtype']}, `{a['revision']}`)" for name, a in made.items()
        ),
        "machine": f"`{platform.machine()}`, {program['device']}",
        "python": platform.python_version(),
        "date": datetime.now(UTC).isoformat(timespec="minutes"),
    }


def writable(folder: Path) -> None:
    """Make a folder. Raises SweepError if it can't be written in."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise SweepError(f"{folder}: is no folder; --results names another") from None
    except OSError as error:
        raise SweepError(f"{folder}: can't be made: {error.strerror}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise SweepError(f"{folder}: can't be written in; --results names another")


def write(path: Path, text: str) -> None:
    """Write a page, whole or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
