"""One formatter: text, Markdown and JSON from the same rows."""

import json

from benchmarks.machine import machine
from benchmarks.tables import TARGET, Table, render, summary, target

ROWS = [
    {"name": "engine", "s": summary([3.0, 1.0, 2.0])} | target(0.9, at_least=0.9),
    {"name": "a peer"},
]
TABLE = Table("Two rows", [("", "{name}"), ("s", "{s[best]:.2f}"), *TARGET], ROWS, ["a note"])


def test_text_aligns_the_columns():
    lines = render(machine(), {"two": TABLE}).splitlines()
    assert lines[-5:] == [
        "Two rows",
        "           s        target  met",
        "engine  1.00  at least 0.9  yes",
        "a peer",
        "a note",
    ]


def test_markdown_has_the_same_cells():
    text = render(machine(), {"two": TABLE}, "markdown")
    assert text.startswith("- ") and text.endswith(
        "**Two rows**\n\n"
        "|  | s | target | met |\n"
        "| --- | ---: | ---: | ---: |\n"
        "| engine | 1.00 | at least 0.9 | yes |\n"
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


def test_a_target_is_met_or_not():
    assert target(3.1, at_most=3.0) == {"target": "at most 3", "met": False}
    assert target(1.0) == {}
