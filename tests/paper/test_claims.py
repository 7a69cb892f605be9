"""The claims: verdicts computed from numbers that independent code confirms."""

import shlex
import string
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pandas as pd
import pytest
import typer

from fic_jax import Model, Params
from sweeps import LIBRARY, runner
from sweeps.cli import app
from sweeps.paper.claims import CLAIMS, chosen
from sweeps.paper.judge import Claim, Judgement, judge
from sweeps.paper.pages import claim_section, number
from sweeps.paper.report import READING
from sweeps.paper.scenarios import LOCATED, PRINTED, STUDIES, Reading, scenarios, study
from sweeps.paper.words import read
from sweeps.spec.mistakes import SweepError
from sweeps.spec.reading import load
from tests.reference import discrete

CLAIM = {claim.id: claim for claim in CLAIMS}


@lru_cache
def judged(id):
    """A claim as the report judges it: at the printed period, and at shorter ones."""
    return judge(CLAIM[id], READING)


# --- the bounds ----------------------------------------------------------------------------------

INF = float("inf")
EDGES = {  # a scenario that is barely as claimed, then changes by which it no longer is
    "C1": [{"nmse": 0.1, "nmse_tail": 1e-4}, {"nmse": 0.1001}, {"nmse_tail": 1.001e-4}],
    "C2": [{"convergence_time": 0.75}, {"convergence_time": 0.751}, {"convergence_time": 0.333}],
    "C3": [{"nmse": 1.0, "named": 1.0, "without": 0.49, "finer": 9.0, "K0": 1.0, "Td": 1.0},
           {"nmse": 1.01}, {"without": 0.5}],
    "C4": [{"mean_error": -4.95}, {"mean_error": -4.949}, {"mean_error": -5.051}],
    "C5": [{"nmse_tail": 0.0317, "convergence_time": 1.5}, {"nmse_tail": 0.0316},
           {"nmse_tail": 0.317}, {"convergence_time": 1.501}, {"convergence_time": 0.666}],
    "C6": [{"contact_time": 1.0, "contact_lost": 0.0}, {"contact_lost": 0.01},
           {"contact_time": INF}],
    "C7": [{"highest": -1e-9, "last": -0.01, "left": 0.99},
           {"highest": 0.0}, {"last": -0.0099}, {"left": 1.0}, {"left": -1.0}],
    "C8": [{"spike": 0.99, "spike_damped": 2.01, "turns": 2, "turns_damped": 1},
           {"spike": 1.0}, {"spike_damped": 2.0}, {"turns_damped": 2},
           {"turns": 1, "turns_damped": 0}],
    "C9": [{"nmse": 3.0, "error": 10.0}, {"nmse": 3.001}, {"nmse": 1.333}],
    "C10": [{"residual": 0.01, "convergence_time": 1.0, "time_15": 1.0},
            {"residual": 0.0101}, {"convergence_time": 1.0011},
            {"convergence_time": INF, "time_15": INF}],
    "C11": [{"share": 0.999}, {"share": 0.9989}],
    "C12": [{"change": 1e-5}, {"change": 1.01e-5}, {"change": -1.01e-5}],
    "C13": [{"distance": 0.01}, {"distance": 0.0101}],
    "C14": [{"gained": 0.01, "moving": 0.01}, {"gained": 0.0101}, {"moving": 0.0101}],
    "C15": [{"swing": 1.01, "extra": 0.01}, {"swing": 1.0101}, {"extra": 0.0101}],
}  # fmt: skip


@pytest.mark.parametrize("id", CLAIM)
def test_a_scenario_is_as_claimed_up_to_the_bound(id):
    edge, *changes = EDGES[id]
    rows = pd.DataFrame([edge, *(edge | change for change in changes)])
    good = judge(replace(CLAIM[id], table=lambda _: rows, conditions=[])).table.good
    assert good.tolist() == [True] + [False] * len(changes)


# --- from a table to a verdict -------------------------------------------------------------------


def judgement(good, periods, parts):
    """Of scenarios with these periods and columns of flags, which are the conditions."""
    columns = {name: np.array(flags, bool) for name, flags in parts.items()}
    table = pd.DataFrame({"period": periods, "ok": np.array(good, bool), **columns})
    return judge(Claim("C0", lambda _: table, [], [], "ok", list(parts)))


@pytest.mark.parametrize(
    ("good", "periods", "parts", "verdict", "where"),
    [
        ([1, 1, 1], [1, 1, 1], {"a": [1, 0, 0]}, "holds", [""]),
        ([1, 1, 0], [1, 1, 1], {"few": [1, 0, 0], "more": [1, 1, 0]}, "holds where", ["more"]),
        # the first of two that are as large
        ([1, 1, 0], [1, 1, 1], {"a": [1, 0, 0], "b": [0, 1, 0]}, "holds where", ["a"]),
        ([1, 0, 0], [1, 1, 1], {"none": [0, 0, 0]}, "does not hold", []),
        ([1, 0, 0], [1, 1, 1], {"mixed": [1, 1, 0]}, "does not hold", []),
        # the paper's period comes first: another only adds to it where it covers more
        ([1, 0, 1, 1], [1, 1, 2, 2], {"a": [1, 0, 1, 1]}, "holds where", ["a", "period == 2"]),
        ([1, 0, 1, 0], [1, 1, 2, 2], {"a": [1, 0, 1, 0]}, "holds where", ["a"]),
        ([0, 0, 1, 0], [1, 1, 2, 2], {"a": [1, 0, 1, 0]}, "holds where", ["period == 2 and a"]),
        ([1, 1, 0, 0], [1, 1, 2, 2], {"a": [0, 0, 1, 1]}, "holds", [""]),
    ],
)  # fmt: skip
def test_a_verdict_follows_from_the_table(good, periods, parts, verdict, where):
    found = judgement(good, periods, parts)
    assert (found.verdict, found.where) == (verdict, where)


def test_no_scenario_proves_nothing():
    table = pd.DataFrame({"x": [1.0]})[:0]
    assert Judgement(CLAIM["C8"], table.assign(good=[], trusted=[], printed=[])).where == []


def test_a_scenario_that_is_not_trusted_counts_neither_way():
    """Nor does the claim hold where one is."""
    table = pd.DataFrame({"x": [1, 1, 0, 1], "x_trusted": [1, 1, 0, 0], "a": [1, 1, 0, 0]})
    table["period"] = 1.0
    found = judge(Claim("C0", lambda _: table, [], [], "x == 1", ["a == 1"]))
    assert (found.where, found.score) == (["a == 1"], 1.0)
    assert [(len(r.counted), r.left_out) for r in found.regions] == [(2, 2), (2, 0)]
    bad = table.assign(x_trusted=[1, 1, 1, 0])
    assert judge(Claim("C0", lambda _: bad, [], [], "x == 1", [])).score == pytest.approx(2 / 3)


def test_only_columns_of_the_condition_have_to_be_trusted():
    table = pd.DataFrame({"nmse": [1.0], "nmse_tail": [1.0], "nmse_trusted": [False]})
    table = table.assign(nmse_tail_trusted=True)
    found = judge(Claim("C0", lambda _: table, [], [], "nmse_tail == 1", []))
    assert found.table["trusted"].tolist() == [True]


# --- the fifteen ---------------------------------------------------------------------------------

# claim -> queries of its verdict, share as claimed, as claimed of the scenarios in each line
FAST = "period == 0.001 and K0 <= 100 and Td <= Fmax"
EXPECTED = {
    "C1": (["K0 <= 10 and 5 <= Td <= Fmax", FAST], 7 / 19,
           "7/20 7/15 7/12 6/8 7/9 6/6 3/3 2/2 12/20 12/12 11/20 8/8 7/20 6/6"),
    "C2": (["K0 == 10 and Td <= Fmax", FAST], 5 / 20,
           "5/20 5/15 5/12 4/8 5/9 4/6 3/3 2/2 12/20 12/12 7/20 6/6 7/20 6/6"),
    "C3": (["K0 >= 1"], 1.0, "19/20 16/16 14/15 12/12 15/20 15/15 0/20 0/20"),
    "C4": (["K0 <= 100", "period == 0.001"], 4 / 5, "4/5 4/4 5/5 5/5 4/5 4/4"),
    "C5": ([], 0.0, "0/20 0/15 0/12 0/8 0/9 0/6 0/3 0/2 0/20 0/20 0/20"),
    "C6": ([""], 1.0, "5/5 1/5 3/5 3/3 4/5 3/3"),
    "C7": (["Denv == 189.7 and Kenv <= 100"], 2 / 5, "2/5 2/4 2/3 2/3 2/2 1/1 0/5 1/5 1/1 1/5 1/1"),
    "C8": ([""], 1.0, "1/1 0/1 0/1 1/1"),
    "C9": ([], 0.0, "0/1 0/1 0/1 0/1"),
    "C10": (["1 <= K0 <= 10 and gap == 0", "period == 0.001 and K0 <= 100 and gap == 0"], 11 / 24,
            "11/25 11/21 11/16 11/12 8/8 0/4 0/5 0/4 16/25 16/16 15/25 12/12 11/25 8/8"),
    "C11": ([""], 1.0, "5/5 20/20"),
    "C12": (["place != 'end'"], 36 / 48, "36/48 36/36 24/24"),
    "C13": (["e_M <= x0 or gain != 1"], 6 / 10, "6/10 6/6 4/4"),
    "C14": None,
    "C15": (["schedule != 'in step'"], None, "123/126 63/63 120/120 24/24"),
}  # fmt: skip


@pytest.mark.parametrize("id", [id for id, expected in EXPECTED.items() if expected])
def test_the_verdict_and_what_it_counts(id):
    where, score, counts = EXPECTED[id]
    found = judged(id)
    assert found.where == where
    assert score is None or found.score == pytest.approx(score)
    lines = [f"{region.counted['good'].sum()}/{len(region)}" for region in found.shown()]
    assert " ".join(lines) == counts


NUMBERS = [
    # located switches: what settles is known to eight digits
    ("C1", 1e-3, {"tail_100": 1.520e-3, "tail_1": 0.5738, "fine": 3.597e-6, "fine_1000": 1.100e-3}),
    ("C2", 3e-3, {"from": 0.383, "to": 0.659, "stiff": 6.11, "fine_from": 0.348, "fine_to": 0.437}),
    # of the cycle itself, which is trusted; its runs with another sigma are not all
    ("C3", 1e-2, {"named": 1.0016, "without": 0.02721, "wider": 0.0667}),
    # 0.5 %: the joint still swings a little about the spring's balance
    ("C4", 5e-3, {"from": -5.0, "to": -5.0, "slow": -8.95}),
    # the joint never leaves the stop: its tail is that of the welded study
    ("C5", 1e-3, {"named": 1.520e-3, "welded": 1.520e-3, "count": 7, "both": 0, "left": 1}),
    ("C6", 7e-3, {"lost": 0.0, "count": 4, "fine": 3.085}),
    ("C7", 5e-3, {"largest": 0.0796, "half": 0.471}),
    # at the touch itself: a sample of 10 ms showed 9.6
    ("C8", 5e-3, {"spike": 11.722, "bare": 0.4582, "turns": 3, "turns_damped": 1}),
    ("C9", 5e-3, {"nmse": 0.3334, "error": 10.722, "error_63": 2.905}),
    ("C10", 0.0, {"gone": 12, "all": 24, "sooner": 14, "never": 5}),
    # (1 - K0 x0/Fmax) exp(-20) and its inverse for 1e-3, at K0 = 0.1
    ("C11", 2e-3, {"short": 2.06e-9, "S": np.log(1e3 * (1 - 0.01 / 15)), "share_5": 0.9933}),
    # all of E_K(e_M) is lost up to x0
    ("C12", 1e-3, {"linear": 1.0, "least": 0.0719, "most": 1.0}),
    ("C13", 1e-2, {"beyond": 0.130, "largest": 0.361}),
    # in the last 10 s of 40
    ("C15", 0.03, {"small": 0.59, "grown": 3.6, "beats": 0}),
]


@pytest.mark.parametrize(("id", "rtol", "expected"), NUMBERS, ids=lambda given: str(given)[:3])
def test_the_numbers_in_the_words(id, rtol, expected):
    found = read(f"claims/{id}").numbers(judged(id).table)
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=rtol), name


def test_c12_v_is_constant_between_switches():
    """1e-5 of V is 4th order's error at 400 steps a peak."""
    assert read("claims/C12").numbers(judged("C12").table)["inside"] < 1e-5


def test_c14_a_stiffening_spring_gives_more_than_it_takes():
    """Which draws fail hangs on single switches; that some do, and few of the older law, not."""
    found = judged("C14")
    numbers = read("claims/C14").numbers(found.table)
    assert found.verdict == "holds where"
    assert 3 <= numbers["bad"] <= 15 and numbers["older"] <= 2
    soft = found.regions[-1]  # one reference, no spring that stiffens
    assert len(soft) == 15 and soft.complete()


def test_another_reading_gives_another_verdict():
    """With the older law the linear zone's shape is still everybody's."""
    older = judge(CLAIM["C13"], Reading(Model(law="energy")))
    assert older.verdict == "holds where"
    assert older.table.distance.max() != judged("C13").table.distance.max()


# --- scenarios and independent numbers -----------------------------------------------------------


def reference(row):
    """nmse, tail, settling time and time out of contact by the plain-Python simulator."""
    p = {name: float(row[name]) for name in vars(Params())}
    choices = {"law": "algorithm1", "divergence": "velocity", "peak": "latched",
               "feedback": "interaction", "contact": row["contact"]}  # fmt: skip
    path = discrete.simulate(p, choices, 0.01, 1000)
    m = discrete.metrics(path, p, choices, 0.01)
    return [m[name] for name in ("nmse", "nmse_tail", "convergence_time", "contact_lost")]


@pytest.mark.parametrize("name", ["welded", "contact", "impact"])
def test_independent_code_measures_the_same(name):
    """C1, C2, C5, C6: float64 on both sides. Where the joint turns hundreds of times, rounding
    decides a limit cycle's phase; there only whether it settles is compared."""
    for _, row in study(name, PRINTED).iterrows():
        ours = [row.nmse, row.nmse_tail, row.convergence_time, row.contact_lost]
        theirs = reference(row)
        if row.mode_switches < 50:
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-12)
        assert np.isinf(ours[2]) == np.isinf(theirs[2])


def test_the_scenarios_are_those_of_the_paper():
    welded = scenarios("paper-welded")
    assert set(welded.K0) == {0.1, 1, 10, 100, 1000} and set(welded.Td) == {1, 5, 10, 20}
    assert len(welded) == 20 and set(welded.contact) == {"welded"}
    far = scenarios("paper-stiffness", "paper-damping")
    pairs = [(50, 189.7), (100, 189.7), (500, 189.7), (100, 0), (100, 63.2)]
    assert list(zip(far.Kenv, far.Denv, strict=True)) == pairs
    assert set(far.gap) == set(far.xd) == {0.5} and set(far.contact) == {"hard_stop"}
    varied = scenarios("paper-stiffness", xd=(0.0, 0.1))
    assert varied[["Kenv", "xd"]].value_counts().tolist() == [1] * 6


@pytest.mark.parametrize("name", STUDIES)
def test_a_store_has_the_numbers_of_the_claims(tmp_path, name):
    """The heatmaps of `make sweep` show them: to the digits of the report, cell by cell."""
    own = study(name, LOCATED).drop_duplicates(["K0", "Td", "Kenv", "Denv"])
    for sweep in STUDIES[name]:
        path = tmp_path / f"{sweep}.zarr"
        store = runner.start(path, load(LIBRARY / f"{sweep}.toml"), None, 64)
        runner.run(store, lambda _: None)
        cells = {metric: store.group[metric][:].ravel() for metric in SHOWN}
        keys = ["K0", "Td", "Kenv", "Denv"]
        both = scenarios(sweep)[keys].assign(**cells)
        both = both.merge(own, on=keys, suffixes=("", "_claimed"))
        assert len(both) == len(cells["nmse"])
        for metric in SHOWN:
            assert (
                both[metric].map(number).tolist() == both[f"{metric}_claimed"].map(number).tolist()
            )


SHOWN = ("nmse", "nmse_tail", "convergence_time", "contact_lost")


# --- words and commands --------------------------------------------------------------------------


@pytest.mark.parametrize("id", CLAIM)
def test_the_printed_command_makes_the_numbers_beside_it(id, capsys, monkeypatch):
    """In this process: the tables are in memory, and JAX has been set up."""
    monkeypatch.setattr(runner, "configure", lambda precision: None)
    section = claim_section(judged(id))
    program, *arguments = shlex.split(section.command)
    assert program == "fic-sweep"
    typer.main.get_command(app)(arguments, standalone_mode=False)
    printed = capsys.readouterr().out
    assert section.text in printed and section.heading in printed


@pytest.mark.parametrize("id", CLAIM)
def test_every_number_is_in_the_words_and_every_brace_is_filled(id):
    words = read(f"claims/{id}")
    text = words.body + words.head["summary"]
    names = {name for _, name, _, _ in string.Formatter().parse(text) if name}
    assert names == set(words.head["numbers"]) | {"verdict"}
    section = claim_section(judged(id))
    assert not set("{}") & set(section.text + section.row["measured"])
    assert "nan" not in section.text.split()


def test_claims_are_numbered_and_named():
    assert [claim.id for claim in CLAIMS] == [f"C{i}" for i in range(1, 16)]
    assert [claim.id for claim in chosen(["c3", "C1", "c3"])] == ["C3", "C1"]
    with pytest.raises(SweepError, match="--only C16: is no claim; there are C1, C2"):
        chosen(["C16"])
