"""The report as Markdown, and as one HTML file."""

import base64
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from markdown_it import MarkdownIt
from markdown_it.token import Token

from sweeps.paper.findings import name_of
from sweeps.paper.judge import Judgement
from sweeps.paper.words import FOLDER, read, rows

MOST_ROWS = 30  # of a table of scenarios
BADGES = {"holds": "yes", "holds where": "part", "does not hold": "no"}  # classes of page.css


@dataclass(frozen=True)
class Section:
    """A part of the report, in Markdown."""

    id: str  # what links name
    title: str
    figure: str  # stem of its picture
    text: str  # words and tables
    command: str  # makes the numbers
    row: Mapping[str, str]  # of the overview
    details: str = ""  # a table that opens on a click

    @property
    def heading(self) -> str:
        return f"## {self.title}"

    def shown(self, picture: str = "") -> str:
        """The whole section; `picture` is the address of its picture."""
        parts = [f'<a id="{self.id}"></a>', self.heading, self.text, self.details]
        parts += [f"Command: `{self.command}`", f"![{self.title}]({picture})" if picture else ""]
        return "\n\n".join(part for part in parts if part)


def claim_section(judgement: Judgement) -> Section:
    """What the report says of a claim."""
    id, words = judgement.claim.id, read(f"claims/{judgement.claim.id}")
    numbers = words.numbers(judgement.table)
    verdict = verdict_of(judgement)
    opening = (
        f"**{judgement.verdict.capitalize()}**{verdict.partition('**')[2].partition('**')[2]}."
    )
    title = words.head["title"]
    text = [
        words.body.format_map(numbers | {"verdict": opening}),
        f"A scenario is as claimed where `{judgement.claim.good}`.{_left_out(judgement)}",
        table(_regions(judgement)),
    ]
    row = {
        "": f"[{id}](#{id})",
        "claim": title,
        "verdict": verdict,
        "scenarios as claimed": f"{100 * judgement.score:.0f} %",
        "not trusted": str(judgement.regions[0].left_out),
        "as ode4 prints": _share(judgement),
        "measured": words.head["summary"].format_map(numbers),
    }
    command = f"fic-sweep report --only {id}"
    figure = words.head["figure"]
    return Section(
        id, f"{id}: {title}", figure, "\n\n".join(text), command, row, _scenarios(judgement)
    )


def finding_section(finding: ModuleType, data: xr.Dataset) -> Section:
    """What the report says of a finding."""
    name = name_of(finding)
    words = read(f"findings/{name}")
    text = words.body.format_map(words.numbers(finding.rows(data)))
    lines = finding.lines(data).to_dict("records")
    columns = words.head["table"].items()
    cells = {title: [cell.format_map(line) for line in lines] for title, cell in columns}
    text = f"{text}\n\n{table(pd.DataFrame(cells))}"
    title = words.head["title"]
    row = {"": f"[{title}](#{name})"}
    return Section(name, title, name, text, "fic-sweep report", row)


def verdict_of(judgement: Judgement) -> str:
    """The verdict in Markdown, with the queries of its conditions."""
    conditions = ", or where ".join(f"`{query}`" for query in judgement.where if query)
    return f"**{judgement.verdict}** {conditions}".strip()


def _left_out(judgement: Judgement) -> str:
    """How many scenarios do not count and why, and what ode4 prints."""
    whole = judgement.regions[0]
    words = ""
    if whole.left_out:
        words += (
            f" {whole.left_out} of {len(whole)} are not trusted and left out of the counts: a "
            "change of the parameters by their rounding, or half the step, changes their numbers "
            "by more than the bound of `fic_jax.TRUST`. A claim does not hold where one of them is."
        )
    if judgement.ode4 is not None:
        words += " Where ode4 at 10 ms prints another number, it stands in brackets."
    return words


def _share(judgement: Judgement) -> str:
    """The share as claimed of the numbers that ode4 prints."""
    if judgement.ode4 is None:
        return ""
    return f"{100 * rows(judgement.ode4, 'printed')['good'].mean():.0f} %"


def _regions(judgement: Judgement) -> pd.DataFrame:
    """How much of each region is as claimed, and the range of every measured column."""
    lines = []
    for region in judgement.shown():
        line = {
            "where": f"`{region.query}`" if region.query else "as the paper has it",
            "scenarios": len(region),
            "trusted": len(region.counted),
            "as claimed": region.counted["good"].sum(),
        }
        for name in judgement.claim.measured:
            ends = (number(end) for end in region.counted[name].agg(["min", "max"]))
            line[name] = " to ".join(dict.fromkeys(ends)) if len(region.counted) else "-"
        lines.append(line)
    return pd.DataFrame(lines)


def _scenarios(judgement: Judgement) -> str:
    """Every scenario that the paper speaks of; of many, those that are not as claimed."""
    claim, whole = judgement.claim, judgement.regions[0].rows
    title, lines = "Every scenario", whole
    if len(whole) > MOST_ROWS:
        lines = whole[~whole["good"] | ~whole["trusted"]]
        title = f"Scenarios that are not as claimed, {len(lines)} of {len(whole)}"
    if len(lines) > MOST_ROWS:
        title, lines = f"{title}: the first {MOST_ROWS}", lines[:MOST_ROWS]
    if lines.empty:
        return ""
    names = lines[claim.by].map(lambda v: f"{v:.4g}" if isinstance(v, float) else number(v))
    shown = names.join(lines[[*claim.measured, "trusted", "good"]].map(number))
    if judgement.ode4 is not None:
        printed = judgement.ode4.loc[lines.index, [*claim.measured, "good"]]
        for name in printed:
            other = [not _alike(a, b) for a, b in zip(lines[name], printed[name], strict=True)]
            both = shown[name] + " [" + printed[name].map(number) + "]"
            shown[name] = shown[name].where(~np.array(other), both)
    return f"<details><summary>{title}</summary>\n\n{table(shown)}\n\n</details>"


def _alike(a: Any, b: Any) -> bool:
    """Whether two numbers are alike to 1 %; flags are alike if they are equal."""
    return bool(a == b or pd.isna([a, b]).all() or abs(a - b) <= 0.01 * abs(a) < np.inf)


def number(value: Any) -> str:
    """Three digits, as 0.00152 or 1.5e-6; text as it is; NaN is a value that is not trusted."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if np.isnan(value):
        return "not trusted"
    if np.isinf(value):
        return "never" if value > 0 else "-inf"
    mantissa, exponent, power = f"{value:.3g}".partition("e")
    return f"{mantissa}e{int(power)}" if exponent else mantissa


def table(lines: pd.DataFrame) -> str:
    """A table in Markdown."""
    rule = ["---"] * lines.shape[1]
    cells: list[list[str]] = [[*map(str, lines)], rule, *lines.astype(str).to_numpy().tolist()]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def markdown(
    claims: Sequence[Section],
    findings: Sequence[Section],
    provenance: Mapping[str, str],
    pictures: Sequence[str],
    folder: str,
) -> str:
    """The whole report; `pictures` are the stems of those in `folder`, beside the report."""

    def shown(sections: Sequence[Section]) -> str:
        return "\n\n".join(
            s.shown(f"{folder}/{s.figure}.png" if s.figure in pictures else "") for s in sections
        )

    return (FOLDER / "page.md").read_text(encoding="utf-8").format(
        overview=table(pd.DataFrame([section.row for section in claims])),
        claims=shown(claims),
        contents="\n".join(f"- {section.row['']}" for section in findings),
        findings=shown(findings),
        provenance=table(pd.DataFrame({"": list(provenance), " ": list(provenance.values())})),
    )  # fmt: skip


def page_html(text: str, folder: Path) -> str:
    """A report in Markdown as one HTML file, with its pictures inside.

    The pictures' addresses are relative to `folder`.
    """
    markdown = MarkdownIt("commonmark", {"html": True, "xhtmlOut": False}).enable("table")
    tokens = markdown.parse(text)
    _label_cells(tokens)
    body = markdown.renderer.render(tokens, markdown.options, {})
    for verdict, badge in BADGES.items():
        for words in (verdict, verdict.capitalize()):
            marked = f'<strong class="verdict {badge}">{words}</strong>'
            body = body.replace(f"<strong>{words}</strong>", marked)

    def inside(match: re.Match[str]) -> str:
        data = base64.b64encode((folder / match[1]).read_bytes()).decode()
        return f'src="data:image/png;base64,{data}"'

    body = re.sub(r'src="([^":]+\.png)"', inside, body)
    title = text.partition("\n")[0].removeprefix("# ")
    style = (FOLDER / "page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>\n{style}</style></head><body>\n{body}</body></html>\n"
    )


def _label_cells(tokens: Sequence[Token]) -> None:
    """Give each cell of a table the text of its head: on a narrow screen page.css shows it."""
    heads: list[str] = []
    column = 0
    for token, content in itertools.pairwise(tokens):
        if token.type == "thead_open":
            heads = []
        elif token.type == "th_open":
            heads.append("".join(child.content for child in content.children or ()))
        elif token.type == "tr_open":
            column = 0
        elif token.type == "td_open":
            token.attrSet("data-head", heads[column])
            column += 1
