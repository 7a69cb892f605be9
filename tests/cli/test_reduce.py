"""`fic-sweep reduce`, and what one can get wrong about a reduction."""

import subprocess

import pytest

from tests.command import FIC_SWEEP, call, typed
from tests.test_runner import bits

REDUCED = """
name = "small"
[time]
t_end = 0.3
[axes]
K0 = [10.0, 100.0]
Kenv = [50.0, 100.0, 500.0]
Td = [1.0, 5.0, 12.0]
[reduce]
over = ["Td"]
max = ["nmse"]
share = { easy = "nmse < 1" }
"""


@pytest.fixture
def small(tmp_path, monkeypatch):
    (tmp_path / "small.toml").write_text(REDUCED)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder with a store, and the same reduced while it ran."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "small.toml").write_text(REDUCED)
    (folder / "all.toml").write_text(REDUCED.partition("[reduce]")[0])
    call("run", "small.toml", code=0, folder=folder)
    call("run", "all.toml", "--out", "all.zarr", code=0, folder=folder)
    return folder


def test_a_store_is_reduced_plotted_exported_and_verified(run, monkeypatch):
    monkeypatch.chdir(run)
    options = ("--over", "Td", "--max", "nmse", "--share", "easy: nmse < 1")
    ended = typed("reduce", "all.zarr", *options)
    assert (ended.code, ended.stderr) == (0, "")
    assert ended.stdout.startswith("wrote all-reduced.zarr: 6 cells of 18 scenarios\n")
    assert (
        typed("plot", "all-reduced.zarr", "--x", "K0", "--y", "Kenv", "--metric", "nmse_max").code
        == 0
    )
    assert typed("export", "all-reduced.zarr", "--to", "csv").code == 0
    assert typed("export", "small.zarr", "--to", "csv").code == 0
    assert (run / "all-reduced.csv").read_text() == (run / "small.csv").read_text()
    assert "K0" in (run / "small.csv").read_text().splitlines()[0]
    assert "all as written" in typed("verify", "all-reduced.zarr").stdout
    status = typed("status", "small.zarr").stdout
    assert "\nreduced over Td: K0 2 x Kenv 3 = 6 cells\n" in status
    assert "\nvalues    nmse 100 %, easy 100 %\n" in status
    value = "a cell has a value where each of its scenarios has a value (`untrusted = 0`)\n"
    assert value in status and value in ended.stdout
    assert "complete already, 18 scenarios" in typed("resume", "all-reduced.zarr").stdout


def test_a_dry_run_names_both_sizes(small):
    printed = typed("run", "small.toml", "--dry-run").stdout
    assert "K0 2 x Kenv 3 x Td 3 = 18 scenarios of 30 steps\n" in printed
    assert "reduced over Td: K0 2 x Kenv 3 = 6 cells\n" in printed
    assert (
        typed("run", "small.toml", "--set", 'best="Kenv"', "--set", "by=nmse", "--dry-run").code
        == 0
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('["Td"]', '["Tb"]', "`reduce.over` must name dimensions, but has `Tb`; did you mean `Td`"),
        ('["Td"]', '["I"]', "has `I` (which the sweep holds constant); there are K0, Kenv, Td"),
        ('["Td"]', '["K0", "Kenv", "Td"]', "`reduce` must leave a dimension of the sweep"),
        ('["Td"]', '["Td", "Td"]', "`reduce.over` must be different from each other"),
        ('["nmse"]', '["nmze"]', "`reduce.max` must name metrics of the sweep, but has `nmze`;"),
        ("nmse < 1", "nmse ^ 2 < 1", "must be written with a product, as `nmse * nmse`, not with"),
        ("nmse < 1", "nmse <", "`reduce.share.easy` must be a condition, as"),
        ("nmse < 1", "nmze < 1", "alone, but has `nmze`; did you mean `nmse`"),
        ("nmse < 1", "Td < 1", "`reduce.share.easy` must name a metric, but is"),
        ("easy", "diverged", "must have another name: `diverged_share` is taken"),
        ("easy", "9", "`reduce.share` must have names of a letter, then"),
        (
            "share = {",
            'best = "Td"\nby = "nmse"\nshare = {',
            "`reduce.best` must be a dimension that",
        ),
        ("share = {", 'best = "K0"\nshare = {', "`reduce.by` must be given with `reduce.best`"),
        ("share = {", 'by = "nmse"\nshare = {', "`reduce.best` must be given with `reduce.by`"),
        ("share = {", "untrusted = 2\nshare = {", "`reduce.untrusted` must be less than or equal"),
        (
            "share = {",
            "quantiles = { nmse = [1.5] }\nshare = {",
            "of `reduce.quantiles.nmse` must be",
        ),
        ('max = ["nmse"]\nshare = { easy = "nmse < 1" }', "", "must name a statistic"),
        ("over = ", "ovr = ", "unknown key `reduce.ovr`; did you mean `over`?"),
        ("[reduce]\nover", "over", "must stand in [reduce]"),
    ],
)
def test_a_mistake_in_the_table_is_one_line(small, old, new, message):
    assert old in REDUCED
    (small / "small.toml").write_text(REDUCED.replace(old, new, 1))
    ended = typed("run", "small.toml")
    assert (ended.code, ended.stdout) == (2, "")
    assert message in ended.stderr
    assert ended.stderr.startswith("fic-sweep: small.toml: ")
    # each key of the table without its head is a mistake
    assert len(ended.stderr.splitlines()) == (3 if new == "over" else 1)
    assert not list(small.glob("*.zarr"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--over", "Tb", "--max", "nmse"), "all.zarr: `--over` must name dimensions, but has"),
        (("--over", "Td"), "all.zarr: `reduce` must name a statistic (max, min, mean, std,"),
        (("--over", "Td", "--share", "nmse < 1"), "--share nmse < 1: must be NAME:CONDITION, as"),
        (
            ("--over", "Td", "--share", "x: nmse <"),
            "all.zarr: `--share x` must be a condition, as",
        ),
        (("--over", "Td", "--quantile", "nmse"), "--quantile nmse: must be METRIC=PART,..., as in"),
        (
            ("--over", "Td", "--max", "nmse", "--out", "small.zarr"),
            "small.zarr: exists already, with another",
        ),
        (("--over", "Td", "--best", "K0", "--by", "nmze"), "`--by` must name metrics of the"),
        (("--over", "Td", "--best", "K0"), "`--by` must be given with `--best`, but is missing"),
        (("--over", "Td", "--by", "nmse"), "`--best` must be given with `--by`, but is missing"),
        (("--over", "Td", "--max", "nmze"), "`--max` must name metrics of the sweep, but has"),
        (("--over", "Td", "--quantile", "nmse=2"), "value 1 of `--quantile nmse` must be less"),
        (("--over", "Td", "--quantile", "nmse=0.5,0.5"), "`--quantile nmse` must be parts that"),
        (("--over", "Td", "--share", "x: nmze < 1"), "`--share x` must have names of metrics"),
        (("--over", "Td", "--share", "x: nmse = 1"), "`--share x` must be written with `==`, not"),
        (("--over", "Td", "--share", "x: K0 < 1"), "`--share x` must name a metric, but is"),
        (("--over", "Td", "--share", "9: nmse < 1"), "`--share` must have names of a letter, then"),
    ],
)
def test_a_wrong_request_is_one_line_and_writes_nothing(run, monkeypatch, options, message):
    monkeypatch.chdir(run)
    before = set(run.iterdir())
    ended = typed("reduce", "all.zarr", *options)
    assert (ended.code, ended.stdout) == (2, "")
    assert message in ended.stderr and len(ended.stderr.splitlines()) == 1
    assert set(run.iterdir()) == before


def test_a_store_in_the_way_says_which_question_it_answers(run, monkeypatch, tmp_path):
    monkeypatch.chdir(run)
    out = str(tmp_path / "a.zarr")
    options = (
        "--over",
        "Td",
        "--max",
        "nmse",
        "--quantile",
        "nmse=0.5",
        "--share",
        "easy: Td < nmse",
    )
    assert typed("reduce", "all.zarr", *options, "--out", out).code == 0
    there = f"fic-sweep: {out}: exists already"
    question = "over Td: max nmse; quantiles 0.5 of nmse; share of Td < nmse"
    for command in (
        ("reduce", "all.zarr", "--over", "Kenv", "--best", "K0", "--by", "nmse", "--out", out),
        ("run", "all.toml", "--out", out),
    ):
        ended = typed(*command)
        said = f"{there}, with another answer, {question}; --out names another\n"
        assert (ended.code, ended.stderr) == (2, said)
    ended = typed("reduce", "all.zarr", *options, "--out", out)  # the same question
    assert ended.stderr == f"{there}; `fic-sweep resume {out}` continues it, --out names another\n"
    ended = typed("run", "all.toml", "--set", "K0=[1,2]", "--out", "all.zarr")
    assert "all.zarr: exists already, and has another sweep, small; --out names" in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("reduce", "small.zarr", "--over", "K0", "--max", "nmse"), "is reduced already; reduce"),
        (("history", "small.zarr", "--at", "K0=10"), "is reduced, and a cell of it has no motion"),
        (("resume", "small.zarr", "--extend", "small.toml"), "`reduce` can't be extended"),
        (("plot", "small.zarr", "--x", "K0", "--metric", "nmse"), "Did you mean 'nmse_max'?"),
    ],
)
def test_what_a_reduced_store_does_not_do(run, monkeypatch, arguments, message):
    monkeypatch.chdir(run)
    ended = typed(*arguments)
    assert (ended.code, ended.stdout) == (2, "")
    assert message in ended.stderr and len(ended.stderr.splitlines()) == 1


def test_a_killed_run_is_resumed_with_the_same_bits(small):
    """SIGKILL once a block is in the ledger; the run may be over by then."""
    whole = call("run", "small.toml", "--out", "whole.zarr", code=0, folder=small)
    assert "18 scenarios" in whole.stdout
    run = subprocess.Popen(
        [FIC_SWEEP, "run", "small.toml", "--chunk", "1"], cwd=small, stdout=subprocess.DEVNULL
    )
    while run.poll() is None and not list(small.glob("small.zarr/status/c.*")):
        pass
    run.kill()
    run.wait()
    call("resume", "small.zarr", code=0, folder=small)
    assert bits(small / "small.zarr") == bits(small / "whole.zarr")


def test_a_store_with_missing_scenarios_is_not_reduced_unless_asked(run, monkeypatch):
    monkeypatch.chdir(run)
    call("run", "all.toml", "--shard", "1/2", "--chunk", "9", code=0, folder=run)
    (part,) = run.glob("*.1-of-2.zarr")
    call("merge", part.name, "--incomplete", "--out", "half.zarr", code=0, folder=run)
    options = ("--over", "Td", "--max", "nmse")
    for store, message in (
        (part.name, "merge the parts first"),
        ("half.zarr", "`fic-sweep resume"),
    ):
        ended = typed("reduce", store, *options)
        assert (ended.code, ended.stdout) == (2, "")
        assert f"{store}: " in ended.stderr and message in ended.stderr
        assert len(ended.stderr.splitlines()) == 1
    allowed = typed("reduce", "half.zarr", *options, "--untrusted", "0.9")
    said = "where at most 90 % of its scenarios lack a value (`untrusted = 0.9`)"
    assert allowed.code == 0 and said in allowed.stdout
    assert typed("resume", "half.zarr").code == 0
    assert typed("reduce", "half.zarr", *options, "--out", "whole-reduced.zarr").code == 0


def test_a_picture_of_a_reduced_store_needs_no_metric(run, monkeypatch):
    monkeypatch.chdir(run)
    ended = typed("plot", "small.zarr", "--x", "K0", "--y", "Kenv", "--out", "any.png")
    assert (ended.code, ended.stderr) == (0, "")
