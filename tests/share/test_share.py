"""The command `share`: its file, its default pins, and what it refuses."""

import json
import re
from html import unescape

import numpy as np
import pytest

from sweeps.store.opening import dataset, open_store
from tests.command import typed
from tests.explore.conftest import ran
from tests.share.conftest import EVIL, JOINT

SAMPLE = """
name = "random"
[time]
t_end = 0.1
[sample]
n = 8
method = "sobol"
seed = 7
ranges = { K0 = { log = [1.0, 1000.0] } }
"""
REDUCED = JOINT + '[reduce]\nover = ["Td"]\nmax = ["nmse"]\n'


def about(file):
    """What the script of a page reads."""
    text = file.read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="about">(.*?)</script>', text)
    return json.loads(found[1])


def shared(store, tmp_path, *more):
    file = tmp_path / "page.html"
    ended = typed("share", store, "--out", file, *more)
    assert (ended.code, ended.stderr) == (0, "")
    return file


def test_pins_are_the_best_the_median_and_the_worst_trusted_cell_of_the_first_map(joint, tmp_path):
    pins = about(shared(joint, tmp_path))["pins"]
    data = dataset(joint)
    cut = data.isel(contact=1, Td=1)
    trusted = np.sort(cut["nmse"].values[cut["nmse_trusted"].values == 2])
    assert [pin["name"] for pin in pins] == ["best nmse", "median nmse", "worst nmse"]
    expected = [trusted[0], trusted[trusted.size // 2], trusted[-1]]
    assert [np.float32(pin["nmse"]) for pin in pins] == expected
    assert all(pin["note"] == "" for pin in pins)


def test_a_page_begins_with_named_metrics_and_axes(joint, tmp_path):
    more = ("--metric", "peak_torque", "--metric", "nmse_error", "--x", "Td", "--y", "Kenv")
    found = about(shared(joint, tmp_path, *more))
    assert [one["name"] for one in found["metrics"]] == ["peak_torque", "nmse_error"]
    assert {k: found["start"][k] for k in ("metric", "x", "y")} == {
        "metric": "peak_torque",
        "x": "Td",
        "y": "Kenv",
    }


def test_a_page_has_the_record_and_not_the_place_of_the_store(joint, tmp_path):
    text = shared(joint, tmp_path).read_text(encoding="utf-8")
    attrs = open_store(joint).group.attrs
    words = unescape(re.sub(r"<[^>]*>", " ", text[text.index('id="record"') :]))
    for wanted in (attrs["revision"], attrs["jax"], attrs["end"], "I = 5 kg·m²", "Fmax = 15 N·m"):
        assert wanted in words
    assert re.search(r"trusted\s+nmse [\d.]+ %", words)
    assert re.search(r" diverged\s+0\s", words)
    assert "K0 = { log = [10.0, 1000.0], n = 9 }" in words
    assert str(joint.parent) not in text


def test_a_small_file_says_what_it_lacks(joint, tmp_path):
    file = shared(joint, tmp_path, "--size", "0.202")
    assert file.stat().st_size <= 202_000
    text = file.read_text(encoding="utf-8")
    assert re.search(r"A copy of \d+ cells: every \dnd of 9 values of K0", text)
    assert "The whole store has 432 cells. Nothing is averaged. Numbers are rounded to 4" in text


def test_an_unfinished_sweep_says_so(tmp_path):
    store = ran(tmp_path / "part.zarr", JOINT, chunk=80, blocks=[0, 1])
    text = shared(store, tmp_path).read_text(encoding="utf-8")
    assert re.search(r"was not finished when it was copied: \d+ of \d+ blocks are missing", text)


def test_a_reduced_store_has_maps_and_no_motion(tmp_path):
    store = ran(tmp_path / "worst.zarr", REDUCED)
    file = shared(store, tmp_path)
    assert about(file)["start"]["metric"] == "nmse_max"
    assert about(file)["pins"] == []
    assert "has no motion" in file.read_text(encoding="utf-8")
    ended = typed("share", store, "--out", file, "--force", "--pin", "K0=10")
    assert (ended.code, ended.stderr.count("\n")) == (2, 1)
    assert "no motion to pin" in ended.stderr


@pytest.mark.parametrize(
    ("more", "wanted"),
    [
        (["--metric", "nmsee"], "Did you mean 'nmse'?"),
        (["--metric", "nmse_trusted"], "is no metric"),
        (["--pin", "K0=1e6"], "K0 = 1e+06 lies outside the sweep"),
        (["--pin", "Fmax=10"], "'Fmax' does not vary here"),
        (["--pin", "contact=glued"], "There is no value of contact 'glued'"),
        (["--pin", "K0"], "--pin K0: must be KEY=VALUE"),
        (["--pin", "K0=10,K0=100"], "another --pin draws several"),
        ([w for n in range(9) for w in ("--pin", f"K0={10 + 100 * n}")], "name up to 4"),
        (["--x", "gap"], "'gap' does not vary here"),
        (["--x", "K0", "--y", "K0"], "must be two dimensions"),
        (["--size", "0.1"], "--size 0.1: must be more than 0.2 MB"),
        (["--size", "nan"], "--size nan: must be more than 0.2 MB"),
        (["--size", "0.2001"], "raise --size, or name fewer metrics"),
    ],
)
def test_a_wrong_request_is_one_line(joint, tmp_path, more, wanted):
    ended = typed("share", joint, "--out", tmp_path / "page.html", *more)
    assert ended.code == 2, ended.stderr
    lines = [line for line in ended.stderr.splitlines() if "warning" not in line]
    assert len(lines) == 1
    assert wanted in lines[0]
    assert not list(tmp_path.iterdir())


def test_no_other_file_is_replaced(joint, tmp_path):
    file = tmp_path / "page.html"
    file.write_text("mine")
    ended = typed("share", joint, "--out", file)
    assert (ended.code, file.read_text()) == (2, "mine")
    assert "--force replaces it" in ended.stderr
    assert typed("share", joint, "--out", file, "--force").code == 0
    assert [one.name for one in tmp_path.iterdir()] == ["page.html"]
    inside = typed("share", joint, "--out", joint / "page.html")
    assert (inside.code, "lies in the store" in inside.stderr) == (2, True)


def test_what_is_no_map_is_refused(tmp_path):
    ended = typed("share", tmp_path, "--out", tmp_path / "page.html")
    assert (ended.code, "is no result store" in ended.stderr) == (2, True)
    store = ran(tmp_path / "random.zarr", SAMPLE)
    ended = typed("share", store, "--out", tmp_path / "page.html")
    assert (ended.code, ended.stderr.count("\n")) == (2, 1)
    assert "is a random design" in ended.stderr
    assert "fic-sweep plot" in ended.stderr


def test_no_text_of_the_store_is_markup(joint, tmp_path):
    text = shared(joint, tmp_path).read_text(encoding="utf-8")
    assert EVIL not in text
    assert "<img" not in text
    assert unescape(re.search("<h1>(.*?)</h1>", text)[1]) == EVIL
