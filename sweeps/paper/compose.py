"""The whole report: stores, verdicts, sections, pictures, pages."""

import os
import platform
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import xarray as xr

from sweeps.paper import stores
from sweeps.paper.beyond import FINDINGS, Finding
from sweeps.paper.claims import CLAIMS
from sweeps.paper.judge import judge
from sweeps.paper.markdown import markdown
from sweeps.paper.page import Page, conditions_table
from sweeps.paper.record import Claim, Judgement, Reading
from sweeps.paper.web import page_html
from sweeps.provenance import provenance
from sweeps.spec.mistakes import SweepError
from sweeps.store.opening import dataset

# The printed reading; its claims are also tried at shorter periods, of which the paper names none.
READING = Reading(others=(0.001, 0.002, 0.005))
STUDIES = ("paper-welded", "paper-contact", "paper-stiffness", "paper-damping")
PICTURES = "figures"  # folder of the pictures, beside the pages


@dataclass(frozen=True)
class Surroundings:
    """What a report is given from outside: where sweeps and pictures come from, whom to tell."""

    library: Path  # of sweep files
    say: Callable[[str], None]  # a line of progress
    running: stores.Tell  # progress of a store
    go_on: Callable[[], None]  # raises KeyboardInterrupt where a stop was asked for
    draw: Callable[[Path, Mapping[str, xr.Dataset]], Iterable[str]]  # pictures; yields their stems


def compose(
    results: Path,
    given: Surroundings,
    claims: Iterable[Claim] = CLAIMS,
    findings: Iterable[Finding] = FINDINGS,
) -> Page:
    """Make everything under `results` and write report.md and report.html there.

    Raises SweepError where the folder or a store in it can't be used.
    """
    findings = tuple(findings)
    writable(results)
    names = dict.fromkeys((*STUDIES, *(name for f in findings for name in f.stores)))
    paths = stores.ensure(results, names, given.library, given.running)
    judgements = judged(claims, given)
    data = {}
    for finding in findings:
        given.go_on()
        data[finding.name] = finding.measure(*(dataset(paths[name]) for name in finding.stores))
        given.say(f"measured {finding.name.replace('_', ' ')}")
    sections = [finding.section(data[finding.name]) for finding in findings]
    folder = results / PICTURES
    writable(folder)
    pictures = []
    for stem in given.draw(folder, data):
        pictures.append(stem)
        given.say(f"drew {folder / stem}.png")
        given.go_on()
    page = Page(judgements, sections, told(paths), pictures)
    write(results / "report.md", markdown(page, PICTURES))
    write(results / "report.html", page_html(page, folder))
    return page


def judged(claims: Iterable[Claim], given: Surroundings) -> list[Judgement]:
    """Every claim judged, each told as it is."""
    judgements = []
    for claim in claims:
        given.go_on()
        judgements.append(judge(claim, READING))
        given.say(f"{claim.id:4}{judgements[-1].words}")
    return judgements


def lines(judgements: Iterable[Judgement]) -> Iterable[str]:
    """Claims and their numbers, for a terminal."""
    for judgement in judgements:
        claim, table = judgement.claim, conditions_table(judgement.findings)
        yield from ("", f"{claim.id}: {claim.title}", claim.statement, claim.scenario)
        yield from ("; ".join(row) for row in (table.header, *table.rows))
        yield from (f"{judgement.words}: {judgement.reason}",)


def copy(page: Page, results: Path, docs: Path) -> Path:
    """The Markdown page and its pictures once more, for a documentation folder: docs/report.md."""
    writable(docs / "report")
    wanted = {j.claim.figure for j in page.judgements} | {s.figure for s in page.sections}
    for stem in sorted(wanted & set(page.pictures)):
        shutil.copyfile(results / PICTURES / f"{stem}.png", docs / "report" / f"{stem}.png")
    write(docs / "report.md", markdown(page, "report"))
    return docs / "report.md"


def told(paths: Mapping[str, Path]) -> dict[str, str]:
    """Which program made the report, of what, when and where."""
    program = provenance(64)
    packages = ("jax", "jaxlib", "numpy", "scipy", "xarray", "zarr", "matplotlib")
    made = {name: dataset(path).attrs for name, path in paths.items()}
    return {
        "program": f"fic_jax {program['fic_jax']}, revision {program['revision']}",
        "arithmetic": f"numerics {program['numerics']}, {program['arithmetic']}",
        "packages": ", ".join(f"{name} {version(name)}" for name in packages),
        "claims": "double precision",
        "stores": ", ".join(f"{name} ({a['dtype']}, {a['revision']})" for name, a in made.items()),
        "machine": f"{platform.machine()}, {program['device']}, Python {platform.python_version()}",
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
    """Write a page, whole or not at all. Raises SweepError if it can't be."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise SweepError(f"{path}: can't be written: {error.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)
