"""The report: honest pages, the stores it runs and reuses, and the whole of it."""

import base64
import re
from html.parser import HTMLParser
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from sweeps import runner
from sweeps.paper import report
from sweeps.paper.claims import chosen
from sweeps.paper.pages import Section, markdown, number, page_html, table
from sweeps.spec.mistakes import SweepError
from sweeps.store.opening import Counts
from tests.command import call
from tests.store.stores import change_attributes

# --- the pages -----------------------------------------------------------------------------------

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNkYPhfDwAChwGA60e6kgAAAABJRU5ErkJggg=="
)
LINES = pd.DataFrame({"where": ["`a <= b and c < d`", "all"], "n": [1, 20]})


@pytest.fixture
def page(tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "dot.png").write_bytes(PIXEL)
    details = f"<details><summary>More</summary>\n\n{table(LINES)}\n\n</details>"
    row = {"": "[C1](#C1)", "verdict": "**holds where** `a <= b`"}
    text = f"> Said.\n\n**Holds where** `a <= b`. F_K(e_M) < 1.\n\n{table(LINES)}"
    claim = Section("C1", "C1: one", "dot", text, "fic-sweep report --only C1", row, details)
    finding = Section(
        "beyond", "Beyond", "none", "One *word*.\n\n    a < b", "cmd", {"": "[B](#b)"}
    )
    return markdown([claim], [finding], {"date": "today"}, ["dot"], "figures")


class Checker(HTMLParser):
    """Every opened tag is closed, in order; addresses are collected."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses, self.text = [], [], ""

    def handle_starttag(self, tag, attrs):
        self.addresses += [v for k, v in attrs if k in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_a_phone_shows_every_column_of_a_table(page, tmp_path):
    """At 390 pixels a column lay beyond the screen: there, each cell is a line after its head."""
    shown = page_html(page, tmp_path)
    assert shown.count('<td data-head="where">') == 2 * len(LINES)
    assert shown.count('<td data-head="n">') == 2 * len(LINES)
    narrow = shown.partition("@media screen and (max-width: 40rem)")[2].partition("@media print")[0]
    assert "tr, td { display: block; }" in narrow and "content: attr(data-head)" in narrow


def test_the_html_stands_alone_and_shows_queries_as_they_are(page, tmp_path):
    checker = Checker()
    shown = page_html(page, tmp_path)
    checker.feed(shown)
    assert checker.open == []
    assert checker.text.count("a <= b and c < d") == 2  # a table and one that opens
    assert "<code>a &lt;= b</code>" in shown and "F_K(e_M) &lt; 1" in shown
    assert '<strong class="verdict part">Holds where</strong>' in shown
    assert '<strong class="verdict part">holds where</strong>' in shown
    assert "<pre><code>a &lt; b\n</code></pre>" in shown
    assert '<a href="#C1">' in shown and '<a id="C1">' in shown
    assert all(a.startswith(("#", "data:image/png;base64,")) for a in checker.addresses)
    assert not re.search(r"url\(|@import|<script|<link", shown)
    assert shown.count(base64.b64encode(PIXEL).decode()) == 1
    assert "<title>The paper's claims, measured</title>" in shown


def test_the_markdown_has_a_row_and_a_section_for_each_claim(page):
    rows = [line for line in page.splitlines() if line.startswith("| [C")]
    assert rows == ["| [C1](#C1) | **holds where** `a <= b` |"]
    assert page.index("## C1: one") < page.index("Command: `fic-sweep report --only C1`")
    assert page.count("](figures/dot.png)") == 1 and "none.png" not in page
    assert "| date | today |" in page and "{" not in page


def test_numbers_have_three_digits():
    texts = {0.0015162: "0.00152", 1.5e-6: "1.5e-6", np.inf: "never", -np.inf: "-inf", 20.0: "20"}
    assert [number(value) for value in texts] == list(texts.values())
    assert [number(value) for value in (True, np.False_, "end")] == ["yes", "no", "end"]


# --- the stores ----------------------------------------------------------------------------------

TINY = 'name = "tiny"\n[time]\nt_end = 0.5\n[axes]\nK0 = [1.0, 10.0]\nTd = [1.0, 5.0]\n'


@pytest.fixture
def library(tmp_path):
    folder = tmp_path / "library"
    folder.mkdir()
    (folder / "tiny.toml").write_text(TINY)
    return folder


def test_missing_stores_are_run_and_unfinished_ones_resumed(library, tmp_path):
    progresses = []

    def tell(name, progress):
        progresses.append((name, progress.ran, progress.done))

    paths = report.stores(tmp_path / "r", ["tiny"], tell, library)
    assert progresses == [("tiny", 0, 0), ("tiny", 4, 4)]
    with xr.open_zarr(paths["tiny"]) as data:
        assert data["nmse"].dtype == np.float32
        first = data.load()
    runner.reopen(paths["tiny"], 32).ledger.delete([0])  # as if stopped before its only block
    report.stores(tmp_path / "r", ["tiny"], tell, library)
    assert progresses[2:] == [("tiny", 0, 0), ("tiny", 4, 4)]
    with xr.open_zarr(paths["tiny"]) as data:
        xr.testing.assert_equal(data.load(), first)


def test_a_store_that_the_command_line_made_is_used_as_it_is(library, tmp_path):
    """The report computes in double precision: stores of single precision keep their bits."""
    call("run", str(library / "tiny.toml"), "--out", "cli.zarr", folder=tmp_path, code=0)
    paths = report.stores(tmp_path / "r", ["tiny"], lambda *_: None, library)
    with xr.open_zarr(tmp_path / "cli.zarr") as one, xr.open_zarr(paths["tiny"]) as two:
        xr.testing.assert_equal(one, two)


def test_a_store_of_another_program_or_sweep_is_refused_by_name(library, tmp_path):
    paths = report.stores(tmp_path / "r", ["tiny"], lambda *_: None, library)
    (library / "tiny.toml").write_text(TINY.replace("5.0", "6.0"))
    with pytest.raises(SweepError, match=r"tiny\.zarr: holds another sweep than `tiny` of the lib"):
        report.stores(tmp_path / "r", ["tiny"], lambda *_: None, library)
    (library / "tiny.toml").write_text(TINY)
    change_attributes(paths["tiny"], numerics=0)
    with pytest.raises(SweepError, match=r"tiny\.zarr: was begun by another program .*remove it"):
        report.stores(tmp_path / "r", ["tiny"], lambda *_: None, library)


# --- the whole -----------------------------------------------------------------------------------


def draw(folder, data):
    (folder / "profile.png").write_bytes(PIXEL)
    yield "profile"


def make(results, say, **more):
    """A report of one claim and one finding, which needs the store `tiny`."""
    return report.make(results, say, lambda *_: None, draw, claims=chosen(["C11"]), **more)


def test_a_small_report(tmp_path):
    lines, results, docs = [], tmp_path / "results", tmp_path / "docs"
    pages = make(results, lines.append, findings=(), docs=docs)
    assert lines == ["C11 holds", f"drew {results / 'figures' / 'profile'}.png"]
    assert pages == [results / "report.md", results / "report.html", docs / "report.md"]
    assert "](figures/profile.png)" in pages[0].read_text()
    assert "data:image/png" in pages[1].read_text()
    assert "](report/profile.png)" in pages[2].read_text()
    assert (docs / "report" / "profile.png").read_bytes() == PIXEL


def test_an_interrupted_report_leaves_its_stores_and_writes_no_page(library, tmp_path, monkeypatch):
    def stop(_):
        raise KeyboardInterrupt

    finding = ModuleType("tiny")
    finding.STORES = ("tiny",)
    monkeypatch.setattr(report.stores, "__defaults__", (library,))
    results = tmp_path / "results"
    with pytest.raises(KeyboardInterrupt):
        make(results, stop, findings=(finding,))
    assert not Counts.of(runner.open_store(results / "tiny.zarr")).pending
    assert not list(results.glob("*report*"))


def test_the_command(tmp_path):
    printed = call("report", "--only", "c11", folder=tmp_path, code=0).stdout
    assert re.search(r"^## C11: 99\.9 % of Fmax before xb$", printed, re.M)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    wrong = call("report", "--results", "file", folder=tmp_path, code=2).stderr
    assert wrong == "fic-sweep: file: is no folder; --results names another\n"
