"""The report: verdicts computed from numbers that independent code confirms, and honest pages."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr

from fic_jax import Model, Params
from sweeps import runner
from sweeps.paper import compose, online_gains, studies
from sweeps.paper.claims import CLAIMS, PRINTED, chosen
from sweeps.paper.judge import judge, verdict_of
from sweeps.paper.markdown import markdown
from sweeps.paper.page import Page
from sweeps.paper.record import Condition, Evidence, Findings, Reading, Section
from sweeps.paper.stores import ensure
from sweeps.paper.web import page_html, paragraphs
from sweeps.spec.mistakes import SweepError
from sweeps.store.opening import Counts
from tests.command import call
from tests.reference import discrete
from tests.store.stores import change_attributes

CLAIM = {claim.id: claim for claim in CLAIMS}


# --- the verdict ---------------------------------------------------------------------------------


def findings(good, conditions):
    n = len(good)
    evidence = (
        Evidence("one", np.arange(n), np.ones(n, bool), "any"),
        Evidence("other", np.arange(n), np.array(good, bool), "good"),
    )
    where = [Condition(words, np.array(part, bool)) for words, part in conditions.items()]
    return Findings([str(i) for i in range(n)], evidence, where, "")


@pytest.mark.parametrize(
    ("good", "conditions", "verdict"),
    [
        ([1, 1, 1], {"": [1, 1, 1], "part": [1, 0, 0]}, ("holds", "")),
        ([1, 1, 0], {"": [1, 1, 1], "few": [1, 0, 0], "more": [1, 1, 0]}, ("holds where", "more")),
        ([1, 0, 0], {"": [1, 1, 1], "none": [0, 0, 0]}, ("does not hold", "")),
        ([1, 0, 0], {"": [1, 1, 1], "mixed": [1, 1, 0]}, ("does not hold", "")),
        # what the paper speaks of comes first: others only add to it where they cover more
        ([1, 0, 1, 1], {"": [1, 1, 0, 0], "own": [1, 0, 0, 0], "other": [0, 0, 1, 1]},
         ("holds where", "own, or where other")),
        ([1, 0, 1, 0], {"": [1, 1, 0, 0], "own": [1, 0, 0, 0], "other": [0, 0, 1, 0]},
         ("holds where", "own")),
        ([1, 1, 0, 0], {"": [1, 1, 0, 0], "other": [0, 0, 1, 1]}, ("holds", "")),
        ([], {"": []}, ("does not hold", "")),
    ],
)  # fmt: skip
def test_a_verdict_follows_from_the_evidence(good, conditions, verdict):
    assert verdict_of(findings(good, conditions)) == verdict


def test_every_verdict_of_every_claim_has_a_reason_that_its_numbers_fill():
    assert [claim.id for claim in CLAIMS] == [f"C{i}" for i in range(1, 16)]
    judged = judge(CLAIM["C11"])
    for claim in CLAIMS:
        assert set(claim.reasons) == {"holds", "holds where", "does not hold"}
    for verdict in CLAIM["C11"].reasons:
        assert "{" not in replace(judged, verdict=verdict).reason


# --- the numbers ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def judged():
    """At the printed reading and, as the report does, at shorter periods: sweeps only."""
    return {name: judge(CLAIM[name], compose.READING) for name in ("C1", "C2", "C3", "C4", "C6")}


def numbers(judgement, *names):
    return [judgement.findings.numbers[name] for name in names]


def reference(fields, contact, period=0.01, dt=0.01):
    """nmse, tail, settling time and time out of contact by the plain-Python simulator."""
    p = {name: float(v) for name, v in vars(Params()).items()} | fields | {"period": period}
    choices = {"law": "algorithm1", "divergence": "velocity", "peak": "latched",
               "feedback": "interaction", "contact": contact}  # fmt: skip
    path = discrete.simulate(p, choices, dt, round(10.0 / dt))
    m = discrete.metrics(path, p, choices, dt)
    return [m[name] for name in ("nmse", "nmse_tail", "convergence_time", "contact_lost")]


@pytest.mark.parametrize(
    ("study", "contact", "fields"),
    [
        (studies.welded, "welded", ("K0", "Td")),
        (studies.contact, "hard_stop", ("K0", "Td")),
        (studies.impact, "hard_stop", ("Kenv", "Denv", "gap", "xd")),
    ],
)
def test_independent_code_measures_the_same(study, contact, fields):
    """C1, C2, C5, C6: float64 on both sides. Where the joint turns hundreds of times, rounding
    decides a limit cycle's phase; there only whether it settles is compared."""
    ran = study(PRINTED)
    for i in range(len(ran.printed)):
        scenario = {name: float(ran.params[name][i]) for name in fields}
        m = ran.metrics
        ours = [m.nmse[i], m.nmse_tail[i], m.convergence_time[i], m.contact_lost[i]]
        theirs = reference(scenario, contact)
        if m.mode_switches[i] < 50:
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-12)
        assert np.isinf(ours[2]) == np.isinf(theirs[2])


def test_c1_and_c2_hold_where_the_search_is_fast_enough(judged):
    """At 10 ms up to K0 = 10, at 1 ms up to K0 = 100; float64 holds four digits of settled runs."""
    c1, c2 = judged["C1"], judged["C2"]
    fast = "period = 1 ms and K0 <= 100 and Td <= Fmax"
    assert c1.words == f"holds where K0 <= 10 and 5 <= Td <= Fmax, or where {fast}"
    assert c2.words == f"holds where K0 = 10 and Td <= Fmax, or where {fast}"
    assert (c1.score, c2.score) == (7 / 20, 5 / 20)
    measured = numbers(c1, "tail_100", "fine", "fine_1000")
    np.testing.assert_allclose(measured, [1.516e-3, 3.596e-6, 1.099e-3], rtol=1e-3)
    conditions = {c.words: c.where for c in c1.findings.conditions}
    nmse = c1.findings.evidence[0].values[conditions[fast]]
    assert np.max(nmse) == pytest.approx(0.02742, rel=1e-3)
    # on the grid of samples, 10 ms and 1 ms
    times = numbers(c2, "from", "to", "stiff", "fine_from", "fine_to")
    np.testing.assert_allclose(times, [0.39, 0.66, 6.11, 0.348, 0.440], atol=0.0011)


def test_c3_its_search_step_is_not_too_wide(judged):
    """A limit cycle: a tenth holds against the plant step (test of model.md: tens of percent)."""
    c3 = judged["C3"]
    assert c3.verdict == "does not hold"
    named, finer, wider = numbers(c3, "named", "finer", "wider")
    np.testing.assert_allclose([named, finer, wider], [1.07, 6.69, 0.072], rtol=0.1)
    assert numbers(c3, "K0", "Td") == [0.1, 1.0]


def test_c4_what_cannot_be_reached(judged):
    """-5 N·m to 0.5 %: the joint still swings a little about the spring's balance."""
    c4 = judged["C4"]
    assert c4.words == "holds where K0 <= 100, or where period = 1 ms"
    np.testing.assert_allclose(numbers(c4, "from", "to"), -5.0, rtol=5e-3)
    assert numbers(c4, "slow")[0] == pytest.approx(-8.95, rel=2e-3)


def test_c6_contact_is_kept_by_a_slow_search_alone(judged):
    """No sample out of contact at 10 ms; at 1 ms thousands, of which rounding moves a few."""
    c6 = judged["C6"]
    assert (c6.verdict, numbers(c6, "lost", "count")) == ("holds", [0.0, 4])
    assert numbers(c6, "fine")[0] == pytest.approx(3.08, abs=0.02)


@pytest.mark.parametrize(
    ("name", "verdict", "expected", "rtol"),
    [
        # the stop is never left: its tail is that of the welded study
        ("C5", "does not hold", {"named": 1.516e-3, "welded": 1.516e-3, "good": 7}, 1e-3),
        # settled: a plant step of 1 ms moves the residual by 0.4 %
        ("C7", "holds where Denv = 189.7 and Kenv <= 100",
         {"largest": 0.0796, "half": 0.471}, 5e-3),
        # the spike lasts less than a sample of 10 ms: a plant step of 1 ms makes it 20 % higher
        ("C8", "holds", {"spike": 11.5, "bare": 0.46, "swings": 3, "swings_damped": 1}, 0.2),
        ("C9", "does not hold", {"nmse": 0.33, "error": 10.5, "error_63": 2.87}, 0.2),
        ("C10", "holds where K0 <= 10 and in contact from the start",
         {"gone": 13, "sooner": 20, "never": 5}, 0.0),
        # (1 - K0 x0/Fmax) exp(-20) and its inverse for 1e-3, at K0 = 0.1
        ("C11", "holds", {"short": 2.06e-9, "S": np.log(1e3 * (1 - 0.01 / 15))}, 2e-3),
        ("C13", "holds where the peak error is at most x0, or K0 and Fmax scale together",
         {"beyond": 0.130, "largest": 0.361}, 1e-2),
    ],
)  # fmt: skip
def test_the_verdict_and_its_numbers(name, verdict, expected, rtol):
    judgement = judge(CLAIM[name])
    assert judgement.words == verdict
    for key, value in expected.items():
        assert judgement.findings.numbers[key] == pytest.approx(value, rel=rtol), key


def test_c12_v_is_constant_between_switches_and_falls_at_the_end():
    """1e-5 of V is 4th order's error at 400 steps a peak; all of E_K(e_M) is lost up to x0."""
    c12 = judge(CLAIM["C12"])
    assert c12.words == "holds where within both branches and at the peak"
    assert numbers(c12, "inside")[0] < 1e-5
    np.testing.assert_allclose(numbers(c12, "linear", "least"), [1.0, 0.0719], rtol=1e-3)


def test_c14_a_stiffening_spring_gives_more_than_it_takes():
    """Which draws fail hangs on single switches; that some do, and few of the older law, not."""
    c14 = judge(CLAIM["C14"])
    assert c14.verdict == "holds where"
    assert 3 <= numbers(c14, "bad")[0] <= 15
    assert numbers(c14, "older")[0] <= 2
    good = c14.findings.good()[c14.findings.conditions[-1].where]
    assert good.size > 10 and good.all()  # one reference, no spring that stiffens


def test_c15_the_swing_follows_the_derived_factor():
    """sqrt((r - 1)/2) each round, to 0.5 %: the changes fall on a grid of 1 ms."""
    data = online_gains.measure()
    np.testing.assert_allclose(data["factor"], np.sqrt((data["ratio"] - 1) / 2), rtol=5e-3)
    section = online_gains.section(data)
    assert [row[0] for row in section.rows] == ["2", "2.9", "3.2", "4", "10"]


def test_c15_holds_but_in_step_with_the_motion():
    c15 = judge(CLAIM["C15"])
    assert c15.words == "holds where K0 does not change in step with the motion"
    small, grown = numbers(c15, "small", "grown")
    np.testing.assert_allclose([small, grown], [0.59, 3.6], rtol=0.03)  # in the last 10 s of 40


def test_another_reading_gives_another_verdict():
    """The older law keeps V's fall at all of it, and the linear zone's shape is everybody's."""
    older = judge(CLAIM["C13"], Reading(Model(law="energy")))
    assert older.verdict == "holds where"
    assert numbers(older, "largest") != numbers(judge(CLAIM["C13"]), "largest")


# --- the pages -----------------------------------------------------------------------------------

NASTY = "a <b> | *c* `d` & [e](http://f)"
PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


@pytest.fixture
def page(tmp_path):
    (tmp_path / "dot.png").write_bytes(PIXEL)
    judgement = judge(CLAIM["C11"])
    claim = replace(judgement.claim, statement=NASTY, title=NASTY, figure="dot")
    section = Section(
        "Beyond it",
        "One *word*, `code`, x <= y.\n\n    a < b",
        ("|h|",),
        (("**x** < N*m",),),
        "dot",
        "cmd",
    )
    return Page([replace(judgement, claim=claim)], [section], {"date": NASTY}, ["dot"])


class Checker(HTMLParser):
    """Every opened tag is closed, in order; addresses are kept."""

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


def test_the_html_stands_alone_and_shows_texts_as_they_are(page, tmp_path):
    checker = Checker()
    shown = page_html(page, tmp_path)
    checker.feed(shown)
    assert checker.open == []
    assert checker.text.count(NASTY) == 4  # row, heading, statement, date
    assert "<td><strong>x</strong> &lt; N·m</td>" in shown
    assert '<a href="#beyond-it">' in shown and '<h2 id="beyond-it">' in shown
    assert all(a.startswith(("#", "data:image/png;base64,")) for a in checker.addresses)
    assert not re.search(r"url\(|@import|<script|<link", shown)
    assert shown.count(base64.b64encode(PIXEL).decode()) == 2


def test_the_markdown_escapes_and_has_a_row_for_each_claim(page):
    text = markdown(page, "figures")
    rows = [line for line in text.splitlines() if line.startswith("| [C")]
    assert len(rows) == 1
    assert len(re.findall(r"(?<!\\)\|", rows[0])) == 6  # five cells
    assert r"a &lt;b&gt; \| \*c\* \`d\` &amp; \[e\](http://f)" in rows[0]
    assert text.count("](figures/dot.png)") == 2
    assert "One *word*, `code`, x ≤ y.\n" in text  # Markdown already
    assert "| \\|h\\| |\n|---|\n| **x** &lt; N·m |" in text


def test_section_text_in_html():
    blocks = list(paragraphs("One *word* and **two**\nwith `a*b*c`.\n\n    K0 < 3 *x*\n    y"))
    assert blocks[1] == "<pre>K0 &lt; 3 *x*\ny</pre>"
    assert blocks[0].startswith("<p>One <em>word</em> and <strong>two</strong> with <code>")


# --- the stores ----------------------------------------------------------------------------------

TINY = 'name = "tiny"\n[time]\nt_end = 0.5\n[axes]\nK0 = [1.0, 10.0]\nTd = [1.0, 5.0]\n'


@pytest.fixture
def library(tmp_path):
    folder = tmp_path / "library"
    folder.mkdir()
    (folder / "tiny.toml").write_text(TINY)
    return folder


def test_missing_stores_are_run_and_unfinished_ones_resumed(library, tmp_path):
    told = []

    def tell(name, progress):
        told.append((name, progress.ran, progress.done))

    paths = ensure(tmp_path / "r", ["tiny"], library, tell)
    assert told == [("tiny", 0, 0), ("tiny", 4, 4)]
    with xr.open_zarr(paths["tiny"]) as data:
        assert data["nmse"].dtype == np.float32
        first = data.load()
    runner.reopen(paths["tiny"], 32).ledger.delete([0])  # as if stopped before its only block
    ensure(tmp_path / "r", ["tiny"], library, tell)
    assert told[2:] == [("tiny", 0, 0), ("tiny", 4, 4)]
    with xr.open_zarr(paths["tiny"]) as data:
        xr.testing.assert_equal(data.load(), first)


def test_a_store_that_the_command_line_made_is_used_as_it_is(library, tmp_path):
    """The report computes in double precision: stores of single precision keep their bits."""
    call("run", str(library / "tiny.toml"), "--out", "cli.zarr", folder=tmp_path, code=0)
    paths = ensure(tmp_path / "r", ["tiny"], library, lambda *_: None)
    with xr.open_zarr(tmp_path / "cli.zarr") as one, xr.open_zarr(paths["tiny"]) as two:
        xr.testing.assert_equal(one, two)


def test_a_store_of_another_program_or_sweep_is_refused_by_name(library, tmp_path):
    paths = ensure(tmp_path / "r", ["tiny"], library, lambda *_: None)
    (library / "tiny.toml").write_text(TINY.replace("5.0", "6.0"))
    with pytest.raises(SweepError, match=r"tiny\.zarr: holds another sweep than `tiny` of the lib"):
        ensure(tmp_path / "r", ["tiny"], library, lambda *_: None)
    (library / "tiny.toml").write_text(TINY)
    change_attributes(paths["tiny"], numerics=0)
    with pytest.raises(SweepError, match=r"tiny\.zarr: was begun by another program .*remove it"):
        ensure(tmp_path / "r", ["tiny"], library, lambda *_: None)


# --- the whole -----------------------------------------------------------------------------------


def surroundings(library, lines, go_on=lambda: None):
    def draw(folder, data):
        (folder / "profile.png").write_bytes(PIXEL)
        yield "profile"

    return compose.Surroundings(library, lines.append, lambda *_: None, go_on, draw)


@pytest.fixture
def small(library, monkeypatch):
    monkeypatch.setattr(compose, "STUDIES", ("tiny",))
    return library


def test_a_small_report(small, tmp_path):
    lines = []
    results = tmp_path / "results"
    page = compose.compose(results, surroundings(small, lines), [CLAIM["C11"]], [])
    assert lines == ["C11 holds", f"drew {results / 'figures' / 'profile'}.png"]
    assert "](figures/profile.png)" in (results / "report.md").read_text()
    assert "data:image/png" in (results / "report.html").read_text()
    assert compose.copy(page, results, tmp_path / "docs") == tmp_path / "docs" / "report.md"
    assert "](report/profile.png)" in (tmp_path / "docs" / "report.md").read_text()
    assert (tmp_path / "docs" / "report" / "profile.png").read_bytes() == PIXEL


def test_an_interrupted_report_keeps_its_stores_and_writes_no_page(small, tmp_path):
    def stop():
        raise KeyboardInterrupt

    results = tmp_path / "results"
    with pytest.raises(KeyboardInterrupt):
        compose.compose(results, surroundings(small, [], stop), [CLAIM["C11"]], [])
    assert not Counts.of(runner.open_store(results / "tiny.zarr")).pending
    assert not list(results.glob("*report*"))


def test_only_names_claims():
    assert [claim.id for claim in chosen(["c3", "C1", "c3"])] == ["C3", "C1"]
    with pytest.raises(SweepError, match="--only C16: is no claim; there are C1, C2"):
        chosen(["C16"])


def test_the_command(tmp_path):
    told = call("report", "--only", "c11", folder=tmp_path, code=0).stdout
    assert re.search(r"^C11: 99\.9 % of Fmax before xb$", told, re.M)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    wrong = call("report", "--results", "file", folder=tmp_path, code=2).stderr
    assert wrong == "fic-sweep: file: is no folder; --results names another\n"
