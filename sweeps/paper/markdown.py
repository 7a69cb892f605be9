"""A report as Markdown."""

import re
from collections.abc import Callable, Iterator

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
from sweeps.paper.record import Judgement, Section


def markdown(page: Page, folder: str) -> str:
    """The page, its pictures being in `folder` beside it."""
    lines = ["# The paper's claims, measured", "", escaped(INTRODUCTION), "", "## Claims", ""]
    lines += [*_table(claims_table(page), links=True), ""]
    for judgement in page.judgements:
        lines += _claim(judgement, page, folder)
    lines += ["## Beyond the claims", ""]
    lines += [f"- [{escaped(s.title)}](#{anchor(s.title)})" for s in page.sections]
    lines += [""]
    for section in page.sections:
        lines += _section(section, page, folder)
    lines += ["## Provenance", ""]
    lines += _table(Table(("", ""), tuple(page.provenance.items())))
    return "\n".join(lines) + "\n"


def _claim(judgement: Judgement, page: Page, folder: str) -> Iterator[str]:
    claim = judgement.claim
    title, every = scenarios_table(judgement.findings)
    yield from (f'<a id="{claim.id}"></a>', "", f"## {claim.id}: {escaped(claim.title)}", "")
    yield from (f"> {escaped(claim.statement)} ({escaped(claim.source)})", "")
    yield from (f"**{escaped(_capital(judgement.words))}.** {escaped(judgement.reason)}", "")
    yield from (escaped(claim.scenario), "")
    yield from (*_table(conditions_table(judgement.findings)), "")
    yield from (f"<details><summary>{escaped(title)}</summary>", "", *_table(every), "")
    yield from ("</details>", "", f"Command: `{claim.command}`", "")
    yield from _picture(claim.figure, f"{claim.id}: {claim.title}", page, folder)


def _section(section: Section, page: Page, folder: str) -> Iterator[str]:
    # text and cells are Markdown already
    yield from (f'<a id="{anchor(section.title)}"></a>', "", f"## {escaped(section.title)}", "")
    yield from (typeset(section.text.strip()), "")
    yield from (*_table(Table(section.header, section.rows), shown=_cell), "")
    yield from (f"Command: `{section.command}`", "")
    yield from _picture(section.figure, section.title, page, folder)


def _picture(stem: str, title: str, page: Page, folder: str) -> Iterator[str]:
    if page.picture(stem):
        yield from (f"![{escaped(title)}]({folder}/{stem}.png)", "")


def _table(
    table: Table, links: bool = False, shown: Callable[[str], str] | None = None
) -> Iterator[str]:
    shown = shown or escaped
    if not table.rows:
        return
    yield "| " + " | ".join(map(shown, table.header)) + " |"
    yield "|---" * len(table.header) + "|"
    for first, *rest in table.rows:
        head = f"[{escaped(first)}](#{first})" if links else shown(first)
        yield "| " + " | ".join([head, *map(shown, rest)]) + " |"


def _cell(text: str) -> str:
    """Markdown that a table can hold."""
    return " ".join(typeset(text).split()).replace("|", r"\|").replace("<", "&lt;")


def escaped(text: str) -> str:
    """Plain text, nothing of which Markdown or HTML reads as markup."""
    text = typeset(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*_|\[\]~$])", r"\\\1", " ".join(text.split()))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
