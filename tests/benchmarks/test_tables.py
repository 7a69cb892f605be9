"""One formatter: text, Markdown and JSON from the same rows."""

import json

from benchmarks.machine import machine
from benchmarks.tables import Table, measured, render

ROWS = [
    {"name": "engine"} | measured([3.0, 1.0, 2.0], at_least=2.0),
    {"name": "a peer"},
]
COLUMNS = [("", "{name}"), ("s", "{best:.2f}"), ("target", "{target}"), ("met", "{met}")]
TABLE = Table("Two rows", COLUMNS, ROWS, ["a note"])


def test_text_aligns_the_columns():
    lines = render(machine(), {"two": TABLE}).splitlines()
    assert lines[-5:] == [
        "Two rows",
        "           s      target  met",
        "engine  1.00  at least 2  yes",
        "a peer",
        "a note",
    ]


def test_markdown_has_the_same_cells():
    text = render(machine(), {"two": TABLE}, "markdown")
    assert text.startswith("- ") and text.endswith(
        "**Two rows**\n\n"
        "|  | s | target | met |\n"
        "| --- | ---: | ---: | ---: |\n"
        "| engine | 1.00 | at least 2 | yes |\n"
        "| a peer |  |  |  |\n"
        "\na note"
    )


def test_json_has_the_rows_the_machine_and_the_settings():
    where = machine()
    result = json.loads(render(where, {"two": TABLE}, "json", steps=4))
    assert result["machine"] == where and result["settings"] == {"steps": 4}
    assert set(where) == {"cpu", "architecture", "cores", "vector", "load", "versions"}
    assert {"python", "jax", "jaxlib", "numpy", "fic_jax", "c++"} <= set(where["versions"])
    assert result["tables"]["two"] == {"title": "Two rows", "rows": ROWS, "notes": ["a note"]}


def test_the_median_meets_a_target_or_not():
    assert measured([3.0, 3.2, 3.1], at_most=3.0) == {
        "median": 3.1, "best": 3.0, "all": [3.0, 3.2, 3.1], "target": "at most 3", "met": "no"
    }  # fmt: skip
    assert measured([1.0, 2.0], max) == {"median": 1.5, "best": 2.0, "all": [1.0, 2.0]}
