"""A report as Markdown."""

import re
from collections.abc import Iterator

from sweeps.report.page import (
    INTRODUCTION,
    Page,
    Table,
    claims_table,
    conditions_table,
    scenarios_table,
    typeset,
)
from sweeps.report.record import Judgement, Section


def markdown(page: Page, folder: str) -> str:
    """The page, its pictures being in `folder` beside it."""
    lines = ["# The paper's claims, measured", "", escaped(INTRODUCTION), "", "## Claims", ""]
    lines += [*_table(claims_table(page), links=True), ""]
    for judgement in page.judgements:
        lines += _claim(judgement, page, folder)
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
    # the text is Markdown already
    yield from (f"## {escaped(section.title)}", "", section.text.strip(), "")
    yield from (*_table(Table(section.header, section.rows)), "")
    yield from (f"Command: `{section.command}`", "")
    yield from _picture(section.figure, section.title, page, folder)


def _picture(stem: str, title: str, page: Page, folder: str) -> Iterator[str]:
    if page.picture(stem):
        yield from (f"![{escaped(title)}]({folder}/{stem}.png)", "")


def _table(table: Table, links: bool = False) -> Iterator[str]:
    if not table.rows:
        return
    yield "| " + " | ".join(map(escaped, table.header)) + " |"
    yield "|---" * len(table.header) + "|"
    for first, *rest in table.rows:
        head = f"[{escaped(first)}](#{first})" if links else escaped(first)
        yield "| " + " | ".join([head, *map(escaped, rest)]) + " |"


def escaped(text: str) -> str:
    """Plain text, nothing of which Markdown or HTML reads as markup."""
    text = typeset(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*_|\[\]~$])", r"\\\1", " ".join(text.split()))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
