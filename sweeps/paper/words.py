"""Files of words: a head in TOML between two lines of +++, then Markdown with numbers in braces.

The section [numbers] of the head says how each number follows from a table of the claim or
finding: "nmse.max() where printed and Td <= Fmax" is the largest nmse of the rows for which the
query after `where` is true. pandas evaluates both (`DataFrame.eval`).
The section [table] holds the columns of a table: a title, and a cell with numbers in braces.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Words:
    """A file of words, not yet filled in."""

    head: dict[str, Any]
    body: str

    def numbers(self, table: pd.DataFrame) -> dict[str, Any]:
        """What the braces stand for."""
        return {name: value(table, text) for name, text in self.head["numbers"].items()}


def read(name: str) -> Words:
    """The words of `claims/C7`, `findings/readings`, ..."""
    _, head, body = (FOLDER / f"{name}.md").read_text(encoding="utf-8").split("+++\n", 2)
    return Words(tomllib.loads(head), body.strip())


def rows(table: pd.DataFrame, query: str) -> pd.DataFrame:
    """The rows of a table for which a query is true; all if it is empty."""
    return table[evaluated(table, query)] if query else table


def evaluated(table: pd.DataFrame, expression: str) -> Any:
    """An expression of columns: `DataFrame.eval`, which is slow with columns that it does not use.

    The engine is Python: numexpr, if it is installed, would round differently.
    """
    used = [name for name in table if str(name) in expression]
    return table[used].eval(expression, engine="python")


def value(table: pd.DataFrame, text: str) -> Any:
    """`EXPRESSION where QUERY`, evaluated."""
    expression, _, query = text.partition(" where ")
    return evaluated(rows(table, query), expression)
