"""A report as one HTML file: pictures inside, nothing fetched from anywhere."""

import base64
import html
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from sweeps.paper.page import (
    INTRODUCTION,
    Page,
    Table,
    anchor,
    claims_table,
    conditions_table,
    scenarios_table,
    typeset,
)
from sweeps.paper.record import Judgement, Section, Verdict

CLASSES: dict[Verdict, str] = {"holds": "yes", "holds where": "part", "does not hold": "no"}
TITLE = "The paper's claims, measured"
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1d1d1d; background: #fff;
       max-width: 60rem; margin: 0 auto; padding: 1rem; }
h1, h2 { line-height: 1.2; font-weight: 600; }
h2 { margin-top: 2.5rem; border-top: 1px solid #ccc; padding-top: 1rem; }
blockquote { margin: 0 0 1rem; padding-left: .8rem; border-left: 3px solid #ccc; color: #444; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .85rem; margin-bottom: 1rem; }
th, td { text-align: left; vertical-align: top; padding: .25rem .6rem .25rem 0;
         border-bottom: 1px solid #ddd; }
th { font-weight: 600; border-bottom-color: #888; }
img { max-width: 100%; height: auto; }
code, pre { font-size: .85rem; background: #f4f4f4; }
pre { padding: .5rem; overflow-x: auto; }
.verdict { font-weight: 600; padding: .05rem .4rem; border-radius: .2rem; }
.yes { background: #d5ecdd; color: #0b4d26; }
.part { background: #fdf0cc; color: #5c4400; }
.no { background: #f9d9d3; color: #7a1c0c; }
a { color: #1f4e8c; }
@media print { body { font-size: 10pt; max-width: none; }
  h2 { break-after: avoid; } img, tr { break-inside: avoid; } details { display: block; } }
"""


def page_html(page: Page, pictures: Path) -> str:
    """The page, with the pictures of the folder `pictures` inside."""
    body = [f"<h1>{TITLE}</h1>", f"<p>{escaped(INTRODUCTION)}</p>", *_overview(page)]
    for judgement in page.judgements:
        body += _claim(judgement, page, pictures)
    body.append("<h2>Beyond the claims</h2><ul>")
    for section in page.sections:
        link = f'<a href="#{anchor(section.title)}">{escaped(section.title)}</a>'
        body.append(f"<li>{link}</li>")
    body.append("</ul>")
    for section in page.sections:
        body += _section(section, page, pictures)
    body += ["<h2>Provenance</h2>", _table(Table(("", ""), tuple(page.provenance.items())))]
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{TITLE}</title><style>{STYLE}</style></head><body>",
            *body,
            "</body></html>\n",
        ]
    )


def _overview(page: Page) -> Iterator[str]:
    table = claims_table(page)
    yield "<h2>Claims</h2>"
    yield f'<div class="wide"><table><tr>{_cells("th", table.header)}</tr>'
    for judgement, (name, title, _, *rest) in zip(page.judgements, table.rows, strict=True):
        link = f'<td><a href="#{escaped(name)}">{escaped(name)}</a></td>'
        badge = f"<td>{_badge(judgement)}</td>"
        yield f"<tr>{link}{_cells('td', [title])}{badge}{_cells('td', rest)}</tr>"
    yield "</table></div>"


def _badge(judgement: Judgement) -> str:
    kind = CLASSES[judgement.verdict]
    shown = f'<span class="verdict {kind}">{escaped(judgement.verdict)}</span>'
    return f"{shown} {escaped(judgement.condition)}".strip()


def _claim(judgement: Judgement, page: Page, pictures: Path) -> Iterator[str]:
    claim = judgement.claim
    title, every = scenarios_table(judgement.findings)
    yield f'<h2 id="{escaped(claim.id)}">{escaped(claim.id)}: {escaped(claim.title)}</h2>'
    yield f"<blockquote>{escaped(claim.statement)} ({escaped(claim.source)})</blockquote>"
    yield f"<p>{_badge(judgement)}</p><p>{escaped(judgement.reason)}</p>"
    yield f"<p>{escaped(claim.scenario)}</p>"
    yield _table(conditions_table(judgement.findings))
    if every.rows:
        yield f"<details><summary>{escaped(title)}</summary>{_table(every)}</details>"
    yield f"<p>Command: <code>{escaped(claim.command)}</code></p>"
    yield from _picture(claim.figure, f"{claim.id}: {claim.title}", page, pictures)


def _section(section: Section, page: Page, pictures: Path) -> Iterator[str]:
    yield f'<h2 id="{anchor(section.title)}">{escaped(section.title)}</h2>'
    yield from paragraphs(section.text)
    yield _table(Table(section.header, section.rows), inline)
    yield f"<p>Command: <code>{escaped(section.command)}</code></p>"
    yield from _picture(section.figure, section.title, page, pictures)


def _picture(stem: str, title: str, page: Page, pictures: Path) -> Iterator[str]:
    if page.picture(stem):
        data = base64.b64encode((pictures / f"{stem}.png").read_bytes()).decode()
        yield f'<img alt="{escaped(title)}" src="data:image/png;base64,{data}">'


def paragraphs(text: str) -> Iterator[str]:
    """A section's Markdown: paragraphs of `inline`, and lines set apart by four spaces."""
    for block in re.split(r"\n\s*\n", text.strip("\n")):
        lines = block.splitlines()
        if all(line.startswith("    ") for line in lines):
            yield "<pre>" + escaped("\n".join(line[4:] for line in lines)) + "</pre>"
            continue
        yield f"<p>{inline(' '.join(block.split()))}</p>"


def inline(text: str) -> str:
    """A line of Markdown: `code`, *stress*, **more**."""
    shown = re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped(text))
    shown = re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", shown)
    return re.sub(r"\*([^*\s][^*]*)\*", r"<em>\1</em>", shown)


def _table(table: Table, shown: Callable[[str], str] | None = None) -> str:
    rows = "".join(f"<tr>{_cells('td', row, shown)}</tr>" for row in table.rows)
    head = _cells("th", table.header, shown)
    return f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>'


def _cells(kind: str, texts: Sequence[str], shown: Callable[[str], str] | None = None) -> str:
    return "".join(f"<{kind}>{(shown or escaped)(text)}</{kind}>" for text in texts)


def escaped(text: str) -> str:
    """Plain text, nothing of which HTML reads as markup."""
    return html.escape(typeset(text), quote=True)
