"""Rows of numbers as text for a terminal, Markdown for a README, or JSON for programs."""

import json
import statistics
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

Row = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Rows as JSON shows them, and how each becomes cells of text.

    A column is a heading and a format of the row, as ("best", "{best:.2f}"). Where a row lacks the
    value, the cell is empty. The first column is left-aligned.
    """

    title: str
    columns: list[tuple[str, str]]
    rows: list[Row]
    notes: list[str] = field(default_factory=list)

    def cells(self) -> list[list[str]]:
        """The headings, then each row as text."""
        rows = [[_cell(form, row) for _, form in self.columns] for row in self.rows]
        return [[heading for heading, _ in self.columns], *rows]


def measured(
    values: list[float],
    best: Callable[[Iterable[float]], float] = min,
    at_least: float | None = None,
    at_most: float | None = None,
) -> Row:
    """Median, best and all values of the rounds; a target, and whether the median meets it."""
    median = statistics.median(values)
    row: Row = {"median": median, "best": best(values), "all": values}
    if at_least is not None:
        row |= {"target": f"at least {at_least:g}", "met": "yes" if median >= at_least else "no"}
    if at_most is not None:
        row |= {"target": f"at most {at_most:,.4g}", "met": "yes" if median <= at_most else "no"}
    return row


def render(machine: Row, tables: dict[str, Table], form: str = "text", **settings: Any) -> str:
    """The machine and the tables; `form` is text, markdown or json, which also has the settings."""
    if form == "json":
        shown = {k: {"title": t.title, "rows": t.rows, "notes": t.notes} for k, t in tables.items()}
        return json.dumps({"machine": machine, "settings": settings, "tables": shown})
    bullet = "- " if form == "markdown" else ""
    lines = [bullet + line for line in _machine(machine)]
    for table in tables.values():
        lines += markdown(table) if form == "markdown" else _text(table)
    return "\n".join(lines)


def _text(table: Table) -> list[str]:
    cells = table.cells()
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["", table.title]
    for first, *rest in cells:
        padded = [f"{cell:>{width}}" for cell, width in zip(rest, widths[1:], strict=True)]
        lines.append("  ".join([f"{first:{widths[0]}}", *padded]).rstrip())
    return lines + table.notes


def markdown(table: Table) -> list[str]:
    """The lines of a table in Markdown, after an empty one."""
    head, *rows = table.cells()
    rule = ["---", *["---:"] * (len(head) - 1)]
    lines = [f"| {' | '.join(row)} |" for row in (head, rule, *rows)] if rows else []
    return ["", f"**{table.title}**", "", *lines, *(f"\n{note}" for note in table.notes)]


def _cell(form: str, row: Row) -> str:
    try:
        return form.format(**row)
    except LookupError:
        return ""


def _machine(machine: Row) -> list[str]:
    vector = ", ".join(machine["vector"]) or "no known vector extension"
    load = " ".join(f"{load:.2f}" for load in machine["load"])
    versions = [f"{name} {version}" for name, version in machine["versions"].items() if version]
    return [
        f"{machine['cpu']} ({machine['architecture']}), {machine['cores']} cores in use, {vector}",
        ", ".join(versions),
        f"load average at the start {load}",
    ]
