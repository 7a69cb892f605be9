"""The results in a folder: a line of JSON for each, as soon as it exists, and the tables of all.

A record has its part, its case and, if it is timed, its round. A later record replaces an earlier
one of the same three, so a second command in the same folder adds to the first. A case that could
not be measured has `why` instead of numbers; when a command begins a part again, the reasons of the
commands before no longer count.
"""

import json
import os
from pathlib import Path
from threading import Lock
from typing import Any

from benchmarks.tables import Row, Table, markdown

NAMED = 10  # cases in a line
BEGIN = "begin"  # the case of a record without numbers


class Results:
    """The records of a folder, on the disk and in memory."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._lock = folder, Lock()
        self._path = folder / "results.jsonl"
        self._records: dict[tuple[str, str, int | None], Row] = {}
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        for line in lines:
            if line.endswith("}"):  # the last one may be cut off
                self._keep(json.loads(line))

    def begin(self, part: str) -> None:
        """Forget why the cases of a part were not measured before."""
        self.add(part, BEGIN)

    def add(self, part: str, case: str, round_: int | None = None, **values: Any) -> None:
        """Append a record; it is on the disk when this returns."""
        record = {"part": part, "case": case, "round": round_, **values}
        with self._lock, self._path.open("a") as file:
            file.write(json.dumps(record) + "\n")
            file.flush()
            os.fsync(file.fileno())
            self._keep(record)

    def of(self, part: str) -> list[Row]:
        """The records of a part."""
        return [record for record in self._records.values() if record["part"] == part]

    def write(self, tables: dict[str, list[Table]]) -> Path:
        """Write tables.md and tables.json; returns the first."""
        blocks = [line for part in tables.values() for t in part for line in markdown(t)]
        rows = {
            part: [{"title": t.title, "rows": t.rows, "notes": t.notes} for t in of_part]
            for part, of_part in tables.items()
        }
        page = self._folder / "tables.md"
        page.write_text("\n".join(blocks).strip() + "\n")
        (self._folder / "tables.json").write_text(json.dumps(rows, indent=1) + "\n")
        return page

    def _keep(self, record: Row) -> None:
        part = record["part"]
        if record["case"] == BEGIN:
            earlier = self._records.items()
            self._records = {k: r for k, r in earlier if r["part"] != part or "why" not in r}
            return
        self._records[part, record["case"], record["round"]] = record


def missing(records: list[Row]) -> list[str]:
    """A line for each reason why cases were not measured, with the first of them."""
    cases: dict[str, list[str]] = {}
    for record in records:
        if "why" in record:
            cases.setdefault(record["why"], []).append(record["case"])
    return [
        f"{'; '.join(of_why[:NAMED])}"
        + (f" and {len(of_why) - NAMED:,} more" if len(of_why) > NAMED else "")
        + f": not measured: {why}"
        for why, of_why in cases.items()
    ]
